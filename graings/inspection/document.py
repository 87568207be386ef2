"""Inspection: what was found in a capture before anything is trained, as a document and as text."""

from __future__ import annotations

import math
from typing import Annotated, Literal

from pydantic import Field

from graings.document import Document
from graings.inspection.consistency import Consistency
from graings.plan.capture_statistics import CaptureStatistics

Vector = tuple[float, float, float]
Distance = Annotated[float, Field(ge=0)]

Subject = Literal["poses", "units", "times", "pictures", "points", "masks"]


class Finding(Document):
    """Something suspicious. A capture with findings can be trained on; the result may not be what is expected."""

    about: Subject = Field(description="What it is about.")
    text: str = Field(description="What was found, with the numbers.")
    remedy: str = Field(description="What to do if it is not meant.")


class Forecast(Document):
    """What a training with one preset is expected to take."""

    minutes: float | None = Field(ge=0, description="Minutes on this machine; null where it is not calibrated.")
    memory_mb: float = Field(gt=0, description="Memory of the training process in MB at its peak.")


class Inspection(Document):
    """What was found in a capture."""

    schema_name: Literal["graings.inspection/1"] = Field(
        "graings.inspection/1", alias="schema", description="Kind and version of this document."
    )
    kind: str = Field(description="Format: transforms, colmap, nerfies or llff.")
    content_hash: str = Field(description="sha256 over the files that were read.")
    images: dict[str, int] = Field(description="Images of each split.")
    source_size: tuple[int, int] = Field(description="Width and height in px of the first picture as it is on disk.")
    time_range: tuple[float, float] | None = Field(description="First and last time in the capture's unit; null: none.")
    background: Vector = Field(description="Colour behind the scene, RGB in [0, 1].")
    masked: int = Field(ge=0, description="Images with a mask of pixels to ignore.")
    center: Vector = Field(description="Centre of the scene in the capture's unit of length.")
    bounds: tuple[Vector, Vector] = Field(
        description="Box about the scene in the capture's unit, least and greatest corner: around the points, or what "
        "the cameras see around the centre."
    )
    up: Vector = Field(description="Axis that points up.")
    camera_distance: tuple[Distance, Distance, Distance] = Field(
        description="Least, median and greatest distance of a camera from the centre, in the capture's unit."
    )
    statistics: CaptureStatistics = Field(description="What the training images show.")
    consistency: Consistency = Field(description="Whether pictures and poses fit together.")
    findings: tuple[Finding, ...] = Field(description="What is suspicious; empty if nothing is.")
    notes: tuple[str, ...] = Field(description="What the reader left out or assumed.")
    forecasts: dict[str, Forecast] = Field(description="Expected cost by preset.")

    def lines(self) -> list[str]:
        """The document as text."""
        s, (least, median, greatest) = self.statistics, self.camera_distance
        counts = ", ".join(f"{count} {split}" for split, count in self.images.items())
        cameras = {"fixed": f"{s.cameras} fixed", "moving": "moving", "mixed": f"{s.cameras}, some fixed"}
        size = f"{self.source_size[0]}x{self.source_size[1]} px on disk, {s.width}x{s.height} as trained on"
        low, high = self.bounds
        first, last = self.time_range or (0.0, 0.0)
        times = (
            "no times (static)"
            if self.time_range is None
            else f"from {time_text(first, last - first)} to {time_text(last, last - first)}"
        )
        box = " to ".join("(" + ", ".join(f"{value:.3g}" for value in corner) + ")" for corner in (low, high))
        found = [
            f"format       {self.kind}: {counts} images",
            f"pictures     {size}; alpha {s.alpha}; background {_hex(self.background)}; {self.masked} masks; "
            f"{s.distorted} of {s.images} undistorted when read",
            f"times        {s.times} of training, {times}",
            f"cameras      {cameras[s.camera_motion]}, {least:.3g} to {greatest:.3g} (median {median:.3g}) from centre",
            f"scene        box {box}, up ({', '.join(f'{value:.2g}' for value in self.up)}), {s.points:,} points",
            f"consistency  {_consistency(self.consistency)}",
        ]
        found += [f"note         {note}" for note in self.notes]
        found += [f"SUSPICIOUS   {finding.text}. {finding.remedy}" for finding in self.findings]
        for preset, forecast in self.forecasts.items():
            minutes = (
                "time unknown: run `graings plan` once" if forecast.minutes is None else f"{forecast.minutes:.1f} min"
            )
            found.append(f"{preset:<12} {minutes}, about {forecast.memory_mb / 1000:.1f} GB of memory")
        return found


def time_text(time: float, span: float) -> str:
    """`time` with six digits of the `span` of all times: those of a clip since 1970 begin with the same ones."""
    before = math.log10(abs(time) / span) if time and span else 0.0
    return f"{time:.{6 + max(0, math.ceil(before))}g}"


def _hex(color: Vector) -> str:
    return "#" + "".join(f"{round(255 * value):02x}" for value in color)


def _consistency(found: Consistency) -> str:
    if found.share is None:
        return f"not tested: {found.reason}"
    text = f"the poses explain {found.share:.0%} of {found.matches} matches between {found.images} images"
    return text if found.other is None else f"{text}; {found.other_share:.0%} if {found.other}"
