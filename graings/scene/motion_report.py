"""Report of a motion basis: its size and its error against the exact scene."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from graings.document import Document


class ErrorStatistics(Document):
    """Errors over the children that have weights and the checked times; `max` over all children."""

    rms: float = Field(ge=0, description="Root of the mean square.")
    p99: float = Field(ge=0, description="What 99 % stay below.")
    max: float = Field(ge=0, description="The largest, of children without weights too.")


class BasisReport(Document):
    """One of the two bases."""

    bound: float = Field(gt=0, description="The bound asked for, of the 0.99 quantile.")
    rank: int = Field(ge=0, description="Number of functions of time.")
    samples: int = Field(ge=1, description="Samples of each function.")
    children: int = Field(ge=0, description="Children with weights; all others do not change more than the bound.")
    bytes: int = Field(ge=0, description="Weights and functions in float32.")
    error: ErrorStatistics = Field(description="Measured, in the unit of the bound.")


class MotionBasisReport(Document):
    """What a motion basis is and how far it is from the exact scene."""

    schema_name: Literal["graings.motion_basis/1"] = Field(
        "graings.motion_basis/1", alias="schema", description="Kind and version of this document."
    )

    children: int = Field(ge=0, description="Children that some time and view may show.")
    views: int = Field(ge=0, description="Training views in which pixels are measured.")
    times: int = Field(ge=1, description="Times at which errors are measured, between those that it is learned from.")
    geometry: BasisReport = Field(
        description="Positions, rotations, log-scales: px in the training view nearest to each."
    )
    residual: BasisReport = Field(description="Colour and opacity of the residual, in grey levels of 255.")
    residual_of_views: ErrorStatistics = Field(
        description="What averaging the residual's colour over views adds to its error, in grey levels of 255."
    )
    seconds: float = Field(ge=0, description="Time it took.")

    @property
    def line(self) -> str:
        """The errors in one line of text."""
        moved, seen = self.geometry.error, self.residual.error
        return (
            f"{self.geometry.rank} functions of time for {self.geometry.children} of {self.children} Gaussians: in the "
            f"training views within {moved.p99:.2g} px for 99 % (RMS {moved.rms:.2g}, largest {moved.max:.2g}), "
            f"residual within {seen.p99:.2g} grey levels"
        )
