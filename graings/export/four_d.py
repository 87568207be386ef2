"""four_d: a model at all times as a .4dgs file, whose Gaussians live for a part of the clip and move in straight lines.

The clip is cut into equal parts. A Gaussian has a record for each of them, with its state in the middle and its mean
velocity; parts in which it stays the same share a record. The package `fourdgs` (extra `splats`) writes the file.
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from graings import constants
from graings.camera.units import Units
from graings.errors import CheckpointError
from graings.export.harmonics_fit import fit_splats
from graings.export.selection import Selection
from graings.render import PreparedScene
from graings.scene.splats import Splats
from graings.storage.model import Model

_C0: Final = 0.28209479177387814  # the spherical harmonic of degree 0
_HARMONICS: Final = (-4.0, 4.0)  # range of the byte that the format has for each higher coefficient

# A Gaussian has stayed the same where no value has changed by more: lengths are relative to its smallest axis, and
# displacements within a part count as lengths.
_LENGTH, _SCALE, _ROTATION, _COLOR = 0.05, 0.02, 0.004, 0.5 / 255

Rows = dict[str, NDArray[Any]]


@dataclass(frozen=True, slots=True, eq=False)
class FourDFile:
    """The file, its number of records, how many Gaussians of all parts were dropped, and the harmonics' degree."""

    data: bytes
    records: int
    dropped: int
    degree: int


def four_d_file(model: Model, parts: int, degree: int | None, selection: Selection) -> FourDFile:
    """`model` in `parts` equal parts of its clip. Its seconds are the capture's units of time; one instant lasts 1 s.

    Harmonics have the `degree` 0 to 3, or None: what the first part needs. Raises `CheckpointError` without the
    package, and `ValueError` where nothing is left.
    """
    try:
        import fourdgs
    except ModuleNotFoundError as error:
        remedy = "pip install 'graings[splats]'"
        raise CheckpointError(f"{model.path}: .4dgs needs the package fourdgs: {remedy}") from error
    scene, cameras = PreparedScene(model.scene), [view.camera for view in model.views["train"]]
    duration = model.units.time_span or 1.0
    slots = scene.slots.numpy()
    began = np.full(len(slots), -1)  # the part in which the open record of each Gaussian begins; -1: it has none
    held: Rows = {}
    closed: list[Rows] = []
    dropped = 0

    def close(which: NDArray[np.bool_], part: int) -> None:
        window = {"began": began[which], "ended": np.full(int(which.sum()), part)}
        closed.append({name: values[which] for name, values in held.items()} | window)
        began[which] = -1

    for part in range(parts):
        fit = fit_splats(scene, cameras, (part + 0.5) / parts, degree=degree)
        kept = selection.kept(fit, model.units)
        dropped += int((~kept).sum())
        splats, children = fit.splats.rows(kept), fit.children[kept]
        degree = splats.degree
        at = np.searchsorted(slots, children.numpy())
        first, last = (scene.geometry(time / parts, torch.from_numpy(at))[0] for time in (part, part + 1))
        rows = _rows(splats, last - first, model.units)
        for name, values in rows.items():
            held.setdefault(name, np.zeros((len(slots), *values.shape[1:]), dtype=values.dtype))
        same = (began[at] >= 0) & _same({name: values[at] for name, values in held.items()}, rows)
        ended = began >= 0
        ended[at[same]] = False
        close(ended, part)
        for name, values in rows.items():
            held[name][at[~same]] = values[~same]
        began[at[~same]] = part
    close(began >= 0, parts)
    records = {name: np.concatenate([rows[name] for rows in closed]) for name in closed[-1]}
    if len(records["began"]) == 0:
        raise ValueError("no splat is left at any time: widen the box or the sphere")
    file = io.BytesIO()
    options = fourdgs.WriteOptions(profile="fine", library="graings")
    fourdgs.write(file, _gaussians(fourdgs, records, duration / parts, parts, degree or 0), duration, options=options)
    return FourDFile(file.getvalue(), len(records["began"]), dropped, degree or 0)


def _rows(splats: Splats, moved: Tensor, units: Units) -> Rows:
    """The values of the format in the capture's units; `moved` [n, 3] is how far each Gaussian goes in this part."""
    low, high = _HARMONICS
    rest = splats.harmonics[:, 1:].transpose(1, 2).flatten(1).numpy()
    rgb = (splats.harmonics[:, 0].numpy() * _C0 + 0.5).clip(0.0, 1.0)
    quats = torch.nn.functional.normalize(splats.quats, dim=-1)
    quats = torch.where(quats[:, :1] < 0, -quats, quats)  # q and -q are one rotation, but not the same values
    return {
        "positions": units.points_back(splats.means.double().numpy()),
        "moved": moved.double().numpy() / units.scale,
        "scales": splats.log_scales.double().exp().numpy() / units.scale,
        "rotations": quats[:, [1, 2, 3, 0]].numpy(),
        "colors": np.concatenate([rgb, splats.opacities.clamp_max(constants.ALPHA_MAX).numpy()[:, None]], axis=1),
        "sh": np.rint((rest.clip(low, high) - low) / (high - low) * 255).astype(np.uint8),
    }


def _same(before: Rows, now: Rows) -> NDArray[np.bool_]:
    """Which Gaussians have stayed the same."""
    size = now["scales"].min(axis=1, keepdims=True)
    within = [
        np.abs(now["positions"] - before["positions"]) <= _LENGTH * size,
        np.abs(now["moved"]) <= _LENGTH * size,
        np.abs(before["moved"]) <= _LENGTH * size,
        np.abs(now["scales"] / np.maximum(before["scales"], 1e-30) - 1.0) <= _SCALE,
        np.abs(now["rotations"] - before["rotations"]) <= _ROTATION,
        np.abs(now["colors"] - before["colors"]) <= _COLOR,
        np.abs(now["sh"].astype(np.int64) - before["sh"]) <= 1,
    ]
    return np.asarray(np.concatenate(within, axis=1).all(axis=1))


def _gaussians(fourdgs: Any, rows: Rows, seconds: float, parts: int, degree: int) -> Any:
    """The records for the library; a part takes `seconds`."""
    began, ended = rows["began"] * seconds, rows["ended"] * seconds
    long = (rows["ended"] - rows["began"] > 1)[:, None]
    return fourdgs.GaussianSet(
        positions=rows["positions"].astype(np.float32),
        scales=rows["scales"].astype(np.float32),
        rotations=rows["rotations"].astype(np.float32),
        colors=rows["colors"].astype(np.float32),
        motions=np.where(long, 0.0, rows["moved"] / seconds).astype(np.float32),
        mu_t=((began + ended) / 2).astype(np.float32),
        sigma_t=np.full(len(began), np.inf, dtype=np.float32),
        win_lo=began,
        win_hi=np.where(rows["ended"] == parts, np.inf, ended),  # the end of a window does not belong to it
        sh=rows["sh"] if degree else None,
        sh_degree=degree,
    )
