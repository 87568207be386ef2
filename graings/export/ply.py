"""PLY files of 3D Gaussian Splatting: the format that every tool for splats reads.

A row holds x y z, nx ny nz (0), f_dc_0..2 (coefficient of degree 0), f_rest_* (the others, all of red first), opacity
(before the sigmoid), scale_0..2 (log) and rot_0..3 (w x y z). Values are those of the capture's coordinates.
"""

from __future__ import annotations

import io
import math
from typing import Any, Final

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from plyfile import PlyData, PlyElement, PlyParseError
from torch import Tensor

from graings import constants
from graings.camera.units import Units
from graings.errors import CheckpointError
from graings.scene.splats import MAX_DEGREE, Splats

_POSITION: Final = ("x", "y", "z")
# Splats have no normals. Viewers that read rows of a fixed length, as that of the authors of 3DGS, expect them.
_NORMAL: Final = ("nx", "ny", "nz")
_COLOR: Final = ("f_dc_0", "f_dc_1", "f_dc_2")
_SCALE: Final = ("scale_0", "scale_1", "scale_2")
_ROTATION: Final = ("rot_0", "rot_1", "rot_2", "rot_3")
_LOWEST_OPACITY: Final = 1e-6
_REMEDY: Final = "Name a PLY file of 3D Gaussian Splatting."


def ply_bytes(splats: Splats, units: Units) -> bytes:
    """The file of `splats`, which are in the normalised units that `units` describes.

    Opacities above the cap of one Gaussian's alpha become the cap, which draws the same.
    """
    rest = splats.harmonics[:, 1:].transpose(1, 2).flatten(1)
    names = [*_POSITION, *_NORMAL, *_COLOR, *(f"f_rest_{index}" for index in range(rest.shape[1]))]
    names += ["opacity", *_SCALE, *_ROTATION]
    opacities = splats.opacities.double().clamp(_LOWEST_OPACITY, constants.ALPHA_MAX).logit()
    parts = (
        torch.from_numpy(units.points_back(splats.means.double().numpy())),
        torch.zeros(len(splats), len(_NORMAL)),
        splats.harmonics[:, 0],
        rest,
        opacities[:, None],
        splats.log_scales.double() - math.log(units.scale),
        torch.nn.functional.normalize(splats.quats, dim=-1),
    )
    table = torch.cat([part.double() for part in parts], dim=1).numpy().astype("<f4")
    rows = np.ascontiguousarray(table).view([(name, "<f4") for name in names]).reshape(len(splats))
    file = io.BytesIO()
    PlyData([PlyElement.describe(rows, "vertex")], byte_order="<").write(file)
    return file.getvalue()


def splats_from_ply(name: str, data: bytes) -> tuple[Splats, Units]:
    """The splats of a file and the units that normalise them: the median at the origin, nine tenths within 1.

    The low-pass filter is that of 3DGS, in every image. Raises `CheckpointError` naming the file `name`.
    """
    try:
        rows: NDArray[Any] = PlyData.read(io.BytesIO(data))["vertex"].data
    except (PlyParseError, KeyError, ValueError, MemoryError, UnicodeError, OverflowError) as error:
        raise CheckpointError(f"{name}: no PLY file of splats, or a damaged one ({error}). {_REMEDY}") from error
    names = set(rows.dtype.names or ())
    wanted = (*_POSITION, *_COLOR, *_SCALE, *_ROTATION, "opacity")
    missing = [column for column in wanted if column not in names]
    if missing:
        raise CheckpointError(f"{name}: has no {', '.join(missing)}, so its vertices are no splats. {_REMEDY}")
    rest = sum(column.startswith("f_rest_") for column in names)
    degree = math.isqrt(rest // 3 + 1) - 1
    complete = {f"f_rest_{index}" for index in range(rest)} <= names
    if rest != 3 * degree * (degree + 2) or degree > MAX_DEGREE or not complete:
        raise CheckpointError(f"{name}: has {rest} columns f_rest; 0, 9, 24 or 45 can be drawn. {_REMEDY}")
    if len(rows) == 0:
        raise CheckpointError(f"{name}: holds no splats. {_REMEDY}")

    def columns(*some: str) -> Float[Tensor, "gaussian column"]:
        return torch.from_numpy(np.stack([rows[column].astype(np.float64) for column in some], axis=1))

    means = columns(*_POSITION)
    if not bool(means.isfinite().all()):
        raise CheckpointError(f"{name}: has positions that are not finite. {_REMEDY}")
    units = _units(means.numpy())
    others = columns(*(f"f_rest_{index}" for index in range(rest))) if rest else means.new_empty(len(rows), 0)
    harmonics = torch.cat([columns(*_COLOR)[:, None], others.unflatten(1, (3, -1)).transpose(1, 2)], dim=1)
    splats = Splats(
        means=torch.from_numpy(units.points(means.numpy())).float(),
        quats=columns(*_ROTATION).float(),
        log_scales=(columns(*_SCALE) + math.log(units.scale)).float(),
        opacities=columns("opacity").sigmoid().float()[:, 0],
        harmonics=harmonics.float(),
        blur=constants.BLUR,
        sampling=None,
    )
    return splats, units


def _units(means: NDArray[np.float64]) -> Units:
    center = np.median(means, axis=0)
    reach = float(np.quantile(np.linalg.norm(means - center, axis=1), 0.9))
    scale = 2.0 ** -math.ceil(math.log2(reach)) if reach > 0 else 1.0
    return Units((float(center[0]), float(center[1]), float(center[2])), scale, up=(0.0, -1.0, 0.0))
