"""The command that renders a video. `graings.cli.main` registers it."""

from __future__ import annotations

from pathlib import Path
from time import perf_counter
from typing import Annotated

import typer

from graings.camera.view_request import MAX_SIDE, ViewRequest
from graings.cli.rendering import RenderPath
from graings.cli.terminal import print_line, task_progress
from graings.cli.training import Threads
from graings.export.camera_path import Moves, frames_of
from graings.export.shown import open_shown
from graings.export.video import FPS, MIN_FPS, check_video, video_size, write_video
from graings.export.video_parts import FRAMES
from graings.kernel import use_threads


def video(
    run: RenderPath,
    output: Annotated[
        Path, typer.Option("--output", "-o", help="File: .mp4, .webm, .webp or .gif; without suffix a folder of PNGs.")
    ],
    moves: Annotated[Moves, typer.Option(help="time, at a fixed camera; camera, at the time --t; or both.")] = "both",
    path: Annotated[
        str | None,
        typer.Option(
            help="orbit: once around; views: a spline through training views; or a file: JSON of keys, or nerfstudio's "
            "camera_path.json (default: orbit, or views if all training views are on one side)."
        ),
    ] = None,
    seconds: Annotated[float, typer.Option(min=0.01, max=3600, help="Length.")] = 4.0,
    fps: Annotated[float, typer.Option(min=MIN_FPS, max=FPS, help="Frames per second; at most 100 in a .gif.")] = 30.0,
    t: Annotated[float | None, typer.Option(help="Time from 0 to 1 while only the camera moves (default: 0).")] = None,
    camera: Annotated[
        str | None, typer.Option(help="A view of the capture for a fixed camera, such as test:3.")
    ] = None,
    azimuth: Annotated[float | None, typer.Option(help="Degrees about the vertical axis at the start.")] = None,
    elevation: Annotated[float | None, typer.Option(help="Degrees above the horizon.")] = None,
    radius: Annotated[float | None, typer.Option(help="Distance to the target in the capture's units.")] = None,
    target: Annotated[
        tuple[float, float, float] | None,
        typer.Option(metavar="X Y Z", help="Point to look at, in the capture's units."),
    ] = None,
    fov: Annotated[float | None, typer.Option(help="Horizontal field of view in degrees.")] = None,
    width: Annotated[int | None, typer.Option(min=1, max=MAX_SIDE, help="Pixels.")] = None,
    height: Annotated[int | None, typer.Option(min=1, max=MAX_SIDE, help="Pixels.")] = None,
    background: Annotated[
        str | None, typer.Option(help="white, black, #rrggbb or r,g,b (default: as in training).")
    ] = None,
    up: Annotated[
        tuple[float, float, float] | None,
        typer.Option(metavar="X Y Z", help="Vertical axis of a file of splats (default: 0 -1 0)."),
    ] = None,
    threads: Threads = None,
) -> None:
    """Render a video: time runs, the camera moves, or both."""
    use_threads(threads)
    try:
        check_video(output, fps)
        request = ViewRequest(
            camera=camera,
            azimuth=azimuth,
            elevation=elevation,
            radius=radius,
            target=target,
            fov=fov,
            width=width,
            height=height,
            t=t,
            background=background,
        )
        shown = open_shown(run, up)
        _, _, rgb = request.resolve(shown.views, shown.units, shown.background)
        frames = frames_of(shown, request, path, moves, max(1, round(seconds * fps)))
        width, height = video_size(output, frames[0][0])
    except ValueError as error:
        raise typer.BadParameter(str(error)) from error
    started = perf_counter()
    with task_progress() as bar:
        task = bar.add_task("rendering", total=len(frames))
        try:
            rendered = write_video(
                output, shown, frames, rgb, fps=fps, observe=lambda done: bar.update(task, completed=done)
            )
        except KeyboardInterrupt:
            print_line(f"Interrupted. The same command goes on where it was, to {FRAMES} frames.")
            raise
    elapsed = perf_counter() - started
    kept = "" if rendered == len(frames) else f" ({len(frames) - rendered} of them were there)"
    print_line(
        f"{output}: {len(frames)} frames{kept}, {width} x {height}, {rendered / elapsed:.1f} frames per second to make."
    )
