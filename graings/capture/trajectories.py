"""Trajectories: true positions of surface points over time, where a capture knows them.

A file `trajectories.json` beside the capture: `times` [T] and `positions` [T, M, 3] in the capture's own units.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Final

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from graings.errors import CaptureError

FILE: Final = "trajectories.json"

Position = tuple[float, float, float]


class Trajectories(BaseModel):
    """The file. Times ascend; every point has a position at every time."""

    model_config = ConfigDict(frozen=True, extra="ignore", allow_inf_nan=False)

    times: Annotated[tuple[float, ...], Field(min_length=1)]
    positions: Annotated[tuple[Annotated[tuple[Position, ...], Field(min_length=1)], ...], Field(min_length=1)]

    @model_validator(mode="after")
    def _shapes_agree(self) -> Trajectories:
        if len(self.positions) != len(self.times):
            raise ValueError(f"{len(self.times)} times but positions at {len(self.positions)}")
        if len({len(points) for points in self.positions}) != 1:
            raise ValueError("the number of points differs between times")
        if any(after <= before for before, after in zip(self.times, self.times[1:], strict=False)):
            raise ValueError("times must ascend")
        return self

    def array(self) -> NDArray[np.float64]:
        """Positions [T, M, 3]."""
        return np.array(self.positions)


def read_trajectories(folder: Path) -> Trajectories | None:
    """The trajectories of the capture in `folder`, None where it has none. Raises `CaptureError`."""
    file = folder / FILE
    if not file.is_file():
        return None
    try:
        return Trajectories.model_validate_json(file.read_bytes())
    except ValidationError as error:
        first = error.errors()[0]
        raise CaptureError(
            str(first["msg"]),
            file=FILE,
            field=".".join(map(str, first["loc"])) or "times",
            remedy="Write the file again, or delete it; it is only used to measure motion.",
        ) from error
