"""The commands that write what others read: splats and models. `graings.cli.main` registers them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from graings.cli.terminal import busy_status, print_line
from graings.export.export import FRAMES
from graings.export.selection import Selection
from graings.player.export_file import export_file, export_request
from graings.storage.compact import open_model

ModelPath = Annotated[
    Path, typer.Argument(metavar="RUN", help="Folder of a run, one of its checkpoints, or an exported .graings file.")
]


def export(
    run: ModelPath,
    output: Annotated[
        Path,
        typer.Option(
            "--output",
            "-o",
            help="File to write: .graings, the whole model; .html, a page that plays it, or its .scene.gz; at one time "
            ".ply, .compressed.ply, .spz, .sog, .splat "
            "or .glb; .zip, a sequence of PLY files; .4dgs, pieces of straight motion.",
        ),
    ],
    time: Annotated[
        float | None, typer.Option("--time", "--t", help="Time from 0 to 1 of the splats (default: 0).")
    ] = None,
    frames: Annotated[int | None, typer.Option(help=f"Number of times in a .zip or .4dgs (default: {FRAMES}).")] = None,
    degree: Annotated[
        int | None,
        typer.Option(min=0, max=3, help="Degree of the spherical harmonics of colour (default: what the scene needs)."),
    ] = None,
    box: Annotated[
        tuple[float, float, float, float, float, float] | None,
        typer.Option(metavar="X Y Z X Y Z", help="Keep what is between two corners, in the capture's units."),
    ] = None,
    sphere: Annotated[
        tuple[float, float, float, float] | None,
        typer.Option(metavar="X Y Z R", help="Keep what is within a radius of a point, in the capture's units."),
    ] = None,
    seen: Annotated[bool, typer.Option("--seen", help="Drop splats that no training view shows.")] = False,
) -> None:
    """Write a model as one small file, or its splats at one time in a format of other tools.

    `graings render` accepts a .graings file in place of a run, and shows files of splats.
    """
    try:
        selection = Selection(box, sphere, seen)
        request = export_request(output, time=time, frames=frames, degree=degree, selection=selection)
    except ValueError as error:
        raise typer.BadParameter(str(error)) from error
    model = open_model(run)
    with busy_status("finding the colours and the motion"):
        try:
            line = export_file(model, output, request)
        except ValueError as error:
            raise typer.BadParameter(str(error)) from error
    print_line(f"{output}: {line}.")
