"""The command that makes a capture of a video or of photographs."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import Annotated

import typer

from graings.cli.terminal import print_line, task_progress
from graings.colmap import pycolmap_has_a_build, pycolmap_remedy
from graings.errors import CaptureError
from graings.footage.make_capture import make_capture
from graings.footage.report import lines
from graings.kernel.threads import usable_cores


def capture(
    source: Annotated[Path, typer.Argument(metavar="VIDEO_OR_FOLDER", help="A video, or a folder of photographs.")],
    output: Annotated[Path, typer.Option("--output", "-o", metavar="CAPTURE", help="Folder to write.")],
    frames: Annotated[int, typer.Option(min=8, max=2000, help="Frames to take from a video.")] = 100,
    max_side: Annotated[int, typer.Option(min=64, max=8192, help="Longer side of the images in px.")] = 1000,
    static: Annotated[bool, typer.Option("--static", help="Nothing moves: the capture gets no times.")] = False,
    threads: Annotated[int | None, typer.Option(min=1, help="CPU threads (default: all usable cores).")] = None,
) -> None:
    """Find the cameras of a video or of photographs, and write a capture that `graings train` reads."""
    if find_spec("pycolmap") is None:  # said now, and not after the frames of a long video
        if pycolmap_has_a_build():
            remedy = f"Install it: {pycolmap_remedy()}."
        else:
            remedy = (
                f"Make the capture on another machine, or find the cameras with COLMAP itself: {pycolmap_remedy()}."
            )
        raise CaptureError("finding the cameras needs the package pycolmap", file=source, remedy=remedy)
    with task_progress() as bar:
        tasks = {}

        def observe(phase: str, done: int, total: int) -> None:
            if phase not in tasks:
                tasks[phase] = bar.add_task(phase, total=total)
            bar.update(tasks[phase], completed=done, total=total)

        try:
            report = make_capture(
                source,
                output,
                frames=frames,
                max_side=max_side,
                static=static,
                threads=threads or usable_cores(),
                observe=observe,
            )
        except KeyboardInterrupt:
            print_line(f"Interrupted. The same command continues from what is done in {output}.")
            raise
    for line in lines(report):
        print_line(line)
    print_line(f"Written to {output}. Next: graings train {output} --output RUN.")
