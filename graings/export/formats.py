"""Formats of files of splats: names, writers and reader.

The library `gaussforge` (extra `splats`) writes and reads the compressed formats; it takes and gives PLY.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, Final

from graings.camera.units import Units
from graings.errors import CheckpointError
from graings.export.gltf import glb_bytes
from graings.export.ply import ply_bytes, splats_from_ply
from graings.scene.splats import Splats

SPZ_VERSION: Final = 3  # viewers in browsers refuse version 4
_EXTRA: Final = "needs the package gaussforge: pip install 'graings[splats]'"


def _converted(format: str, splats: Splats, units: Units) -> bytes:
    return _convert("the splats", ply_bytes(splats, units), "ply", format)


WRITERS: Final[dict[str, Callable[[Splats, Units], bytes]]] = {
    "ply": ply_bytes,
    "glb": glb_bytes,
    **{format: partial(_converted, format) for format in ("compressed.ply", "spz", "sog", "splat")},
}

# `gaussforge` 0.6 cannot read the .splat files that it writes.
READABLE: Final = ("compressed.ply", "ply", "spz", "sog", "ksplat")


def suffix_of(path: Path, known: tuple[str, ...]) -> str | None:
    """The longest of `known`, without its dot, with which the name of `path` ends; None if there is none."""
    name = path.name.lower()
    return max((suffix for suffix in known if name.endswith(f".{suffix}")), key=len, default=None)


def read_splats(path: Path) -> tuple[Splats, Units]:
    """Splats and their units from a file in one of the formats `READABLE`. Raises `CheckpointError`, `OSError`."""
    data, format = path.read_bytes(), suffix_of(path, READABLE)
    if format is None:
        raise CheckpointError(f"{path}: no file of splats. Name one that ends in .{', .'.join(READABLE)}.")
    return splats_from_ply(str(path), data if format == "ply" else _convert(str(path), data, format, "ply"))


def _convert(name: str, data: bytes, old: str, new: str) -> bytes:
    try:
        import gaussforge
    except ModuleNotFoundError as error:
        raise CheckpointError(f"{name}: {new if old == 'ply' else old} {_EXTRA}.") from error
    result: dict[str, Any] = gaussforge.GaussForge().convert(data, old, new, spz_version=SPZ_VERSION)
    if "error" in result:
        raise CheckpointError(f"{name}: cannot be converted from {old} to {new} ({result['error']}). Try .ply.")
    found: bytes = result["data"]
    return found
