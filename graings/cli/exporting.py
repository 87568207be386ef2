"""The commands that write what others read: splats and models. `graings.cli.main` registers them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from graings.cli.terminal import busy_status, print_line
from graings.export.export import (
    FRAMES,
    MODEL,
    PAGE,
    SEQUENCE,
    WHOLE,
    ExportRequest,
    export_format,
    export_splats,
)
from graings.export.selection import Selection
from graings.player.html import player_html
from graings.player.scene_file import read_scene, scene_bytes
from graings.storage.compact import open_model, write_compact
from graings.storage.files import write_bytes
from graings.storage.model import Model
from graings.storage.model import scene_bytes as model_bytes

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
            "or .glb; .zip, a sequence of PLY files.",
        ),
    ],
    time: Annotated[float, typer.Option("--time", "--t", help="Time from 0 to 1 of the splats.")] = 0.0,
    frames: Annotated[int, typer.Option(help="Number of times in a .zip.")] = FRAMES,
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
        format = export_format(output)
        selection = Selection(box, sphere, seen)
        request = None if format in WHOLE else ExportRequest(format, time, frames, degree, selection)
        if request is None and selection != Selection():
            raise ValueError(f"a .{format} file holds the whole scene; --box, --sphere and --seen are for splats")
    except ValueError as error:
        raise typer.BadParameter(str(error)) from error
    model = open_model(run)
    if request is None and format != MODEL:
        _export_player(model, format, output)
        return
    if request is None:
        size = write_compact(model, output)
        print_line(f"{output}: {size / 1e6:.2f} MB, {model_bytes(model.scene) / 1e6:.2f} MB in float32.")
        return
    with busy_status("fitting spherical harmonics to the colours"):
        try:
            exported = export_splats(model, request)
        except ValueError as error:
            raise typer.BadParameter(str(error)) from error
    write_bytes(output, exported.data)
    times = f"{request.frames} times" if format == SEQUENCE else f"t = {time:g}"
    print_line(
        f"{output}: {len(exported.data) / 1e6:.2f} MB, {exported.splats:,} splats at {times}, "
        f"harmonics of degree {exported.degree}; {exported.dropped:,} dropped."
    )


def _export_player(model: Model, format: str, output: Path) -> None:
    """Write the scene for the player, or a page with both."""
    with busy_status("finding the functions of time and the colours"):
        scene = scene_bytes(model)
        data = player_html(scene, output.stem) if format == PAGE else scene
    write_bytes(output, data)
    header = read_scene(scene)[1]
    print_line(
        f"{output}: {len(data) / 1e6:.2f} MB, {header.children:,} Gaussians at all times; 99 % of their positions are "
        f"within {header.position_error.p99:.2f} px."
    )
