"""export_file: a model as a file of any format that is written, chosen by the suffix of its name."""

from __future__ import annotations

from pathlib import Path

from graings.export.export import (
    FRAMES,
    MODEL,
    PAGE,
    SEVERAL,
    WHOLE,
    ExportRequest,
    check_used,
    export_format,
    export_splats,
)
from graings.export.selection import Selection
from graings.player.html import player_html
from graings.player.scene_file import read_scene, scene_bytes
from graings.storage.compact import write_compact
from graings.storage.files import check_writable, write_bytes
from graings.storage.model import Model
from graings.storage.model import scene_bytes as model_bytes


def export_request(
    path: Path,
    *,
    time: float | None = None,
    frames: int | None = None,
    degree: int | None = None,
    selection: Selection | None = None,
) -> ExportRequest | None:
    """The request of splats in a file named `path`; None for a format with the whole scene.

    None stands for time 0, `FRAMES` frames and the degree that is needed. Raises `ValueError` for a suffix that is not
    written, values out of range or that the format does not use, and a selection from a whole scene; `OutputError`
    where no file can be written at `path`.
    """
    format, selection = export_format(path), selection or Selection()
    check_used(format, time=time, frames=frames, degree=degree)
    check_writable(path)
    if format not in WHOLE:
        return ExportRequest(format, time or 0.0, FRAMES if frames is None else frames, degree, selection)
    if selection != Selection():
        raise ValueError(f"a .{format} file holds the whole scene; a box, a sphere and `seen` are for splats")
    return None


def export_file(model: Model, path: Path, request: ExportRequest | None) -> str:
    """Write `path` as `export_request` understood it; returns a line on its size and content.

    Raises `ValueError` where no splats are left or the format cannot hold them, and `OutputError`.
    """
    if request is not None:
        exported = export_splats(model, request)
        write_bytes(path, exported.data)
        times = f"{request.frames} times" if request.format in SEVERAL else f"t = {request.time:g}"
        return (
            f"{len(exported.data) / 1e6:.2f} MB, {exported.splats:,} splats at {times}, "
            f"harmonics of degree {exported.degree}; {exported.dropped:,} dropped"
        )
    format = export_format(path)
    if format == MODEL:
        size = write_compact(model, path)
        return f"{size / 1e6:.2f} MB, {model_bytes(model.scene) / 1e6:.2f} MB in float32"
    scene = scene_bytes(model)
    data = player_html(scene, path.stem) if format == PAGE else scene
    write_bytes(path, data)
    header = read_scene(scene)[1]
    return (
        f"{len(data) / 1e6:.2f} MB, {header.children:,} Gaussians at all times; 99 % of their positions are "
        f"within {header.position_error.p99:.2f} px"
    )
