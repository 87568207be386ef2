"""The command that renders a view of a model, or of a file of splats. `graings.cli.main` registers it."""

from __future__ import annotations

import json
from pathlib import Path
from time import perf_counter
from typing import Annotated

import typer

from graings.camera.view_request import MAX_SIDE, ViewRequest
from graings.cli.terminal import print_line
from graings.cli.training import Threads
from graings.evaluation.metrics import psnr
from graings.export.picture import Content, check_content, picture
from graings.export.shown import open_shown
from graings.image_encoding import image_format
from graings.kernel import use_threads
from graings.render import FastScene, PreparedScene, render
from graings.storage.files import check_writable, write_bytes

RenderPath = Annotated[
    Path,
    typer.Argument(
        metavar="RUN",
        help="Folder of a run, a checkpoint, a .graings file, or a file of splats: .ply, .spz, .sog, .ksplat.",
    ),
]


def render_view(
    run: RenderPath,
    output: Annotated[Path, typer.Option("--output", "-o", help="Image file: .png, .jpg, .webp or .exr.")],
    t: Annotated[float | None, typer.Option(help="Time from 0 to 1 (default: that of --camera, or 0).")] = None,
    camera: Annotated[str | None, typer.Option(help="A view of the capture, such as test:3.")] = None,
    azimuth: Annotated[
        float | None, typer.Option(help="Degrees about the vertical axis (default: the side of the training views).")
    ] = None,
    elevation: Annotated[
        float | None, typer.Option(help="Degrees above the horizon (default: median of the training views).")
    ] = None,
    radius: Annotated[
        float | None, typer.Option(help="Distance to the target in the capture's units (default: median).")
    ] = None,
    target: Annotated[
        tuple[float, float, float] | None,
        typer.Option(metavar="X Y Z", help="Point to look at, in the capture's units (default: the centre)."),
    ] = None,
    fov: Annotated[float | None, typer.Option(help="Horizontal field of view in degrees.")] = None,
    pose: Annotated[
        Path | None,
        typer.Option(help="JSON: world_to_camera (4x4, OpenCV axes), fx, width, height; optional: fy, cx, cy."),
    ] = None,
    width: Annotated[int | None, typer.Option(min=1, max=MAX_SIDE, help="Pixels.")] = None,
    height: Annotated[int | None, typer.Option(min=1, max=MAX_SIDE, help="Pixels.")] = None,
    background: Annotated[
        str | None, typer.Option(help="white, black, #rrggbb or r,g,b (default: as in training).")
    ] = None,
    show: Annotated[
        Content,
        typer.Option(
            help="color; rgba, on a transparent background; alpha; depth, in .exr in the capture's units, else "
            "near white and far grey; layers, all of these in one .exr.",
        ),
    ] = "color",
    fast: Annotated[
        bool,
        typer.Option(
            "--fast", help="Approximate the motion, as /render?fast=true does, and print how far it is from exact."
        ),
    ] = False,
    up: Annotated[
        tuple[float, float, float] | None,
        typer.Option(metavar="X Y Z", help="Vertical axis of a file of splats (default: 0 -1 0)."),
    ] = None,
    threads: Threads = None,
) -> None:
    """Render one view at one time; without --camera or --pose, an orbit around the scene."""
    use_threads(threads)
    try:
        format = image_format(output.suffix)
        check_content(show, format)
        check_writable(output)
        request = ViewRequest(
            camera=camera,
            azimuth=azimuth,
            elevation=elevation,
            radius=radius,
            target=target,
            fov=fov,
            pose=None if pose is None else _read_pose(pose),
            width=width,
            height=height,
            t=t,
            background=background,
        )
        shown = open_shown(run, up)
        view, time, rgb = request.resolve(shown.views, shown.units, shown.background)
    except ValueError as error:
        raise typer.BadParameter(str(error)) from error
    if t is not None and time != t:
        print_line(f"Time {t:g} is outside the capture; rendered at {time:g}.")
    scene, approximation = shown.scene, None
    if fast:
        if not isinstance(scene, PreparedScene):
            raise typer.BadParameter("splats do not move: there is no motion to approximate", param_hint="--fast")
        exact = render(scene, view, time, rgb).color
        fast_scene = FastScene.of(scene, shown.views.get("train", ()))
        scene, approximation = fast_scene.seen_by(view), fast_scene.line(view)
    started = perf_counter()
    image = picture(scene, view, time, rgb, shown.units, show, format)
    milliseconds = 1e3 * (perf_counter() - started)
    write_bytes(output, image)
    print_line(f"{output}: {view.width} x {view.height} at t = {time:g}, rendered in {milliseconds:.0f} ms.")
    if approximation is not None:
        similarity = psnr(render(scene, view, time, rgb).color, exact)
        print_line(f"Fast: {approximation}.")
        print_line(f"This image has a PSNR of {similarity:.1f} dB against the exact one.")


def _read_pose(file: Path) -> dict[str, object]:
    """The values of a pose file. Raises `ValueError`."""
    try:
        pose = json.loads(file.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{file}: not JSON ({error})") from error
    if not isinstance(pose, dict):
        raise ValueError(f"{file}: must be a JSON object with world_to_camera, fx, width and height")
    return pose
