"""Scene file: a `PlayerScene` as one small file that browsers read. docs/player.md has its layout.

The file is gzip of: 8 bytes MAGIC, the length of the header in 4 bytes (little-endian), the header (JSON in UTF-8, a
`SceneHeader`), and the tables (`graings.player.columns`).
"""

from __future__ import annotations

import gzip
import json
import struct
import zlib
from collections.abc import Iterator
from typing import Final

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from pydantic import ValidationError
from torch import Tensor

from graings.camera.camera import View
from graings.camera.sampling_rate import RATE_TOLERANCE, SamplingRate
from graings.errors import CheckpointError
from graings.player.bake import Baked, bake, largest_rates, value_sizes
from graings.player.capture_facts import capture_facts
from graings.player.columns import Table, pack, unpack
from graings.player.scene import PlayerScene, PositionError, RasterFacts, SamplingFacts, SceneHeader
from graings.render import PreparedScene
from graings.scene.motion_basis import PLAYER_PIXELS
from graings.scene.time_basis import TimeBasis, quantile
from graings.storage.model import Model

MAGIC: Final = b"GRNSCENE"
MEDIA_TYPE: Final = "application/gzip"
SUFFIX: Final = ".scene.gz"

# Errors of rounding: of positions and shapes in px, of the motion (all functions together) in px RMS, and of colours
# and opacities in levels of 255. All are below what the basis itself may err.
_PIXELS: Final = 0.1
_MOTION_PIXELS: Final = 0.2
_LEVELS: Final = 2.0
_LOG_SCALE: Final = 0.02
_HARMONIC: Final = 0.025

_CHECKED_TIMES: Final = 16


def scene_bytes(model: Model, prepared: PreparedScene | None = None, *, pixels: float = PLAYER_PIXELS) -> bytes:
    """The scene file of `model`, whose motion is within `pixels` of the exact one; `prepared` saves preparing it again.

    Raises `CheckpointError` where nothing can be drawn.
    """
    prepared = prepared or PreparedScene(model.scene)
    try:
        baked = bake(prepared, model.views["train"], pixels=pixels)
    except ValueError as error:
        raise CheckpointError(f"{model.path}: {error}.") from error
    tables, body = _tables(baked)
    scene = baked.scene
    found = _scene({table.name: unpack(table, body) for table in tables}, scene.blur, scene.sampling)
    sampling = scene.sampling
    header = SceneHeader(
        schema="graings.player_scene/1",
        digest=model.digest,
        iteration=model.iteration,
        finished=model.finished,
        children=len(scene),
        moving=len(scene.geometry.rows),
        changing=len(scene.residual.rows),
        degree=scene.degree,
        geometry_rank=scene.geometry.rank,
        residual_rank=scene.residual.rank,
        position_error=_position_error(prepared, baked, found, model.views["train"]),
        color_error=baked.color_error,
        blur=scene.blur,
        sampling=SamplingFacts(
            extent=sampling.extent,
            reference=sampling.reference,
            coarsest=sampling.coarsest,
            tolerance=RATE_TOLERANCE,
        ),
        raster=RasterFacts(),
        capture=capture_facts(model),
        tables=tables,
    )
    text = json.dumps(header.to_json(), separators=(",", ":"), allow_nan=False).encode()
    return gzip.compress(MAGIC + struct.pack("<I", len(text)) + text + body, mtime=0)


def read_scene(data: bytes) -> tuple[PlayerScene, SceneHeader]:
    """Scene and header of a scene file. Raises `CheckpointError`."""
    try:
        plain = gzip.decompress(data)
        if not plain.startswith(MAGIC):
            raise ValueError("it does not begin as one")
        (size,) = struct.unpack_from("<I", plain, len(MAGIC))
        start = len(MAGIC) + 4
        header = SceneHeader.model_validate(json.loads(plain[start : start + size]))
        body = plain[start + size :]
        tables = {table.name: unpack(table, body) for table in header.tables}
        sampling = SamplingRate(header.sampling.extent, header.sampling.reference, header.sampling.coarsest)
        return _scene(tables, header.blur, sampling), header
    except (OSError, EOFError, zlib.error, struct.error, KeyError, ValueError, ValidationError) as error:
        raise CheckpointError(f"no scene file, or a damaged one ({error}). Fetch or write it again.") from error


def _tables(baked: Baked) -> tuple[tuple[Table, ...], bytes]:
    tables: list[Table] = []
    parts: list[bytes] = []
    for name, values, steps, delta in _values(baked):
        table, data = pack(name, values.numpy(), steps, sum(map(len, parts)), delta=delta)
        tables.append(table)
        parts.append(data)
    return tuple(tables), b"".join(parts)


def _values(baked: Baked) -> Iterator[tuple[str, Tensor, ArrayLike, bool]]:
    """Name, values [row, column], steps and whether differences are stored, of each table."""
    scene, sizes = baked.scene, baked.sizes
    per_value = value_sizes(sizes, 10)
    yield "means", scene.means, 2 * _PIXELS / per_value[0], True
    yield "quats", scene.quats, min(0.02, 2 * _PIXELS / per_value[3]), False
    yield "log_scales", scene.log_scales, _LOG_SCALE, False
    yield "opacities", scene.opacities.unsqueeze(1), 0.5 * _LEVELS / 255, False
    constant = 0.5 * _LEVELS / 255 * np.sqrt(4 * np.pi)
    count = scene.harmonics.shape[1]
    steps = np.repeat([constant] + [_HARMONIC] * (count - 1), 3)
    yield "harmonics", scene.harmonics.flatten(1), steps, False
    for name, basis, error in (
        ("geometry", scene.geometry, _MOTION_PIXELS),
        ("residual", scene.residual, _LEVELS),
    ):
        values = value_sizes(sizes, basis.functions.shape[2])
        # Uniform rounding errors of step s have the RMS s / sqrt(12); they add up over the rank.
        allowed = error * np.sqrt(12 / max(1, basis.rank))
        moved = np.linalg.norm(basis.functions.numpy() * values, axis=2).max(0, initial=0)
        yield f"{name}_weights", basis.weights, allowed / np.maximum(moved, 1e-9), False
        flat = basis.functions.flatten(1)
        yield f"{name}_functions", flat, np.tile(allowed / 2 / values, basis.rank), True


def _scene(tables: dict[str, NDArray[np.float32]], blur: float, sampling: SamplingRate) -> PlayerScene:
    found = {name: torch.from_numpy(np.ascontiguousarray(values)) for name, values in tables.items()}
    bases = [
        TimeBasis(
            torch.arange(len(found[f"{name}_weights"])),
            found[f"{name}_weights"],
            found[f"{name}_functions"].unflatten(1, (found[f"{name}_weights"].shape[1], values)),
        )
        for name, values in (("geometry", 10), ("residual", 4))
    ]
    return PlayerScene(
        means=found["means"],
        quats=found["quats"],
        log_scales=found["log_scales"],
        opacities=found["opacities"].squeeze(1),
        harmonics=found["harmonics"].unflatten(1, (-1, 3)),
        geometry=bases[0],
        residual=bases[1],
        blur=blur,
        sampling=sampling,
    )


def _position_error(
    prepared: PreparedScene, baked: Baked, found: PlayerScene, views: tuple[View, ...]
) -> PositionError:
    """Of `found`, as read from the file, at times between those that the motion was learned at."""
    rates = largest_rates(baked.scene.means, [view.camera for view in views])
    rows, inverse = torch.sort(baked.children)
    times = [(number + 0.37) / _CHECKED_TIMES for number in range(_CHECKED_TIMES if prepared.scene.temporal else 1)]
    errors = []
    for time in times:
        exact = torch.empty_like(found.means)
        exact[inverse] = prepared.geometry(time, rows)[0].to(found.means.dtype)
        errors.append((found.means_at(time) - exact).norm(dim=1) * rates)
    together = torch.stack(errors)
    return PositionError(rms=float(together.square().mean().sqrt()), p99=quantile(together), max=float(together.max()))
