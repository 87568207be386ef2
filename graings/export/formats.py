"""Formats of files of splats: names, writers and reader.

The library `gaussforge` (extra `splats`) writes and reads the compressed formats; it takes and gives PLY.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Final

import torch

from graings.camera.units import Units
from graings.errors import CheckpointError
from graings.export.gltf import glb_bytes
from graings.export.ply import ply_bytes, splats_from_ply
from graings.scene.splats import Splats, harmonic_basis

SPZ_VERSION: Final = 3  # viewers in browsers refuse version 4

# SPZ has positions in 24 bits of fixed point, 12 of them behind the point, and log-scales up to 255 / 16 - 10.
_SPZ_STEP: Final = 2.0**-12
_SPZ_REACH: Final = 2.0**11
_SPZ_LARGEST: Final = math.exp(255 / 16 - 10)
# The median splat's largest axis must have this many steps, so that rounding moves it by at most a quarter of its size.
# Splats of 1.7 steps are drawn with 38 dB against the exact ones, of 0.4 steps with 25 dB, of 7 with 47 dB.
_SPZ_STEPS: Final = 2

_EXTRA: Final = "needs the package gaussforge: pip install 'graings[splats]'"


def _converted(format: str, splats: Splats, units: Units) -> bytes:
    if format == "spz":
        _check_spz(splats, units)
        splats, units = half_turn(splats, units)
    if format == "compressed.ply":
        # gaussforge 0.6 writes the coefficients of each harmonic together; readers expect those of each channel.
        rest = splats.harmonics[:, 1:]
        swapped = rest.transpose(1, 2).flatten(1).unflatten(1, rest.shape[1:]) if splats.degree else rest
        splats = replace(splats, harmonics=torch.cat([splats.harmonics[:, :1], swapped], dim=1))
    return _convert("the splats", ply_bytes(splats, units), "ply", format)


def _check_spz(splats: Splats, units: Units) -> None:
    """Raises `ValueError` where the numbers of an SPZ file are too coarse or too small for `splats`."""
    reach = float(abs(units.points_back(splats.means.double().numpy())).max())
    sizes = splats.log_scales.double().amax(1).exp() / units.scale
    largest, median = float(sizes.max()), float(sizes.median())
    if reach >= _SPZ_REACH:
        problem = f"coordinates below {_SPZ_REACH:g}, and here they reach {reach:g}"
    elif largest > _SPZ_LARGEST:
        problem = f"splats up to a size of {_SPZ_LARGEST:.0f}, and here they reach {largest:g}"
    elif median < _SPZ_STEPS * _SPZ_STEP:
        problem = f"coordinates in steps of 1/4096, and here half of the splats are smaller than {median:.2g}"
    else:
        return
    raise ValueError(f"a .spz file holds {problem} in the capture's units; choose .sog or .ply")


def half_turn(splats: Splats, units: Units) -> tuple[Splats, Units]:
    """Turned by 180 degrees about the x axis: from the axes of PLY files, y down, to those of SPZ, y up, and back."""
    flip = splats.means.new_tensor([1.0, -1.0, -1.0])
    direction = splats.means.new_tensor([0.3, 0.5, 0.8])
    signs = (harmonic_basis(direction * flip, splats.degree) * harmonic_basis(direction, splats.degree)).sign()
    w, x, y, z = splats.quats.unbind(-1)
    turned = replace(
        splats,
        means=splats.means * flip,
        quats=torch.stack([-x, w, -z, y], dim=-1),
        harmonics=splats.harmonics * signs[:, None],
    )
    at, up = units.center, units.up
    return turned, replace(units, center=(at[0], -at[1], -at[2]), up=(up[0], -up[1], -up[2]))


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
    found = splats_from_ply(str(path), data if format == "ply" else _convert(str(path), data, format, "ply"))
    return half_turn(*found) if format == "spz" else found


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
