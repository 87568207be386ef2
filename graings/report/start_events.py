"""Start events: with what a training run begins."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from graings.report.training_event import KIND, TrainingEvent

Channel = Annotated[float, Field(ge=0, le=1)]


class BackgroundFound(TrainingEvent):
    """The colour of the background is not white."""

    kind: Literal["background"] = Field("background", description=KIND)
    color: tuple[Channel, Channel, Channel] = Field(description="RGB in [0, 1].")

    def _words(self) -> str:
        name = "#" + "".join(f"{round(255 * channel):02x}" for channel in self.color)
        return f"pixels of the colour {name} count as background"


class PointsInitialized(TrainingEvent):
    """Where the first anchors come from, in a capture without a point cloud whose masks do not show the objects."""

    kind: Literal["initial_points"] = Field("initial_points", description=KIND)
    source: Literal["random", "triangulation"] = Field(
        description="random: uniform in a cube. triangulation: matched between pairs of images."
    )
    triangulated: int | None = Field(
        None,
        ge=0,
        description="Points matched between pairs of images; null where it was not tried. It needs the extra "
        "graings[colmap].",
    )
    within_masks: int | None = Field(
        None, ge=0, description="Random points within the masks, where these were too few; null otherwise."
    )
    interpolated: int = Field(0, ge=0, description="Points added between the triangulated ones.")

    def _words(self) -> str:
        if self.source == "triangulation":
            count, between = f"{self.triangulated:,}", f"{self.interpolated:,}"
            return f"initial points: {count} triangulated from pairs of images, {between} interpolated between them"
        if self.within_masks is not None:
            return (
                f"initial points: random, because only {self.within_masks} of those in view lie within the masks; "
                "check the cameras, or raise init.points if the objects are small in the images"
            )
        if self.triangulated is None:
            return (
                "initial points: random, because there is neither a point cloud nor a mask; "
                "with the extra graings[colmap], where pycolmap has a build, they are triangulated from the images"
            )
        return f"initial points: random, because only {self.triangulated} could be triangulated from pairs of images"


class TimeWindowStarted(TrainingEvent):
    """Training begins with a part of the clip."""

    kind: Literal["time_window"] = Field("time_window", description=KIND)
    share: float = Field(gt=0, lt=1, description="Share of the clip, around its middle, that the first steps use.")

    def _words(self) -> str:
        return f"training begins with the middle {100 * self.share:.3g} % of the clip and widens to all of it"


class LowResolutionStarted(TrainingEvent):
    """Training begins with downscaled images."""

    kind: Literal["low_resolution"] = Field("low_resolution", description=KIND)
    factor: int = Field(gt=1, description="How many times smaller along each side the first images are.")

    def _words(self) -> str:
        return f"training begins with images of 1/{self.factor} of their width and height"


class MotionFound(TrainingEvent):
    """Something crosses the video: training begins with points that follow it."""

    kind: Literal["motion"] = Field("motion", description=KIND)
    tracked_points: int = Field(gt=0, description="Points whose way through the clip was found from moving features.")

    def _words(self) -> str:
        start = f"{self.tracked_points} points that follow what moves"
        return f"training begins with {start}, found before the first step. `time_window=1` prevents this."
