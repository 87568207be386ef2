"""Events: what happened in a training run beside its ordinary steps, one small model for each kind.

Those of its start are in `start_events`.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from graings.report.start_events import (
    BackgroundFound,
    LowResolutionStarted,
    MotionFound,
    PointsInitialized,
    TimeWindowStarted,
)
from graings.report.training_event import KIND, TrainingEvent


class Grew(TrainingEvent):
    """Anchors were added."""

    kind: Literal["grew"] = Field("grew", description=KIND)
    anchors: int = Field(gt=0, description="How many anchors were added.")

    def _words(self) -> str:
        return f"grew {self.anchors:,} anchors"


class GrowthCapped(TrainingEvent):
    """More anchors qualified for growth than could be added."""

    kind: Literal["growth_capped"] = Field("growth_capped", description=KIND)
    anchors: int = Field(ge=0, description="Anchors of the scene after this growth.")
    max_anchors: int = Field(gt=0, description="Anchors that the scene may have.")

    def _words(self) -> str:
        budget = f"{self.anchors:,} of at most {self.max_anchors:,} anchors"
        return f"growth was limited: {budget}, and more qualified than may be added at once"


class Pruned(TrainingEvent):
    """Anchors that show nothing were removed."""

    kind: Literal["pruned"] = Field("pruned", description=KIND)
    anchors: int = Field(gt=0, description="How many anchors were removed.")

    def _words(self) -> str:
        return f"pruned {self.anchors:,} anchors"


class Unseen(TrainingEvent):
    """After the last step, anchors that no training view shows were removed."""

    kind: Literal["unseen"] = Field("unseen", description=KIND)
    anchors: int = Field(gt=0, description="How many anchors were removed.")

    def _words(self) -> str:
        return f"removed {self.anchors:,} anchors that no training view shows"


class Thinned(TrainingEvent):
    """More anchors were there from the start than the budget allows: a random part of them was removed."""

    kind: Literal["thinned"] = Field("thinned", description=KIND)
    anchors_before: int = Field(gt=0, description="Anchors before.")
    anchors_after: int = Field(gt=0, description="Anchors after.")

    def _words(self) -> str:
        before, after = f"{self.anchors_before:,}", f"{self.anchors_after:,}"
        return f"thinned {before} anchors to {after}: the budget leaves no room for growth"


class GrowthQuiet(TrainingEvent):
    """Several growths in a row added no anchor."""

    kind: Literal["growth_quiet"] = Field("growth_quiet", description=KIND)
    growths: int = Field(gt=0, description="How many growths in a row added none.")
    ended: bool = Field(description="Whether growth and its statistics end; plan.mode=aggressive ends them.")

    def _words(self) -> str:
        then = "growth ends" if self.ended else "plan.mode=aggressive would end growth here"
        return f"{self.growths} growths in a row added no anchor: {then}"


class PartDropped(TrainingEvent):
    """Training measured that a part of the model does not show, and leaves it out from here on."""

    kind: Literal["part_dropped"] = Field("part_dropped", description=KIND)
    component: str = Field(description="The part, as the plan names it.")
    bound: float = Field(ge=0, description="Greatest change of a pixel of a training view, values in [0, 1].")

    def _words(self) -> str:
        return (
            f"the {self.component} is left out: it changes no training view by more than {255 * self.bound:.2g} levels"
        )


class GradientsClipped(TrainingEvent):
    """The gradients of one group of parameters were far above their usual norm and were scaled down."""

    kind: Literal["clipped"] = Field("clipped", description=KIND)
    group: str = Field(description="Parameter group; screen: gradients of the projected centres.")
    norm: float = Field(gt=0, description="Euclidean norm of the group's gradients.")
    limit: float = Field(gt=0, description="Norm they were scaled down to.")
    views: tuple[str, ...] = Field(description="Views of the step.")

    def _words(self) -> str:
        views = ", ".join(self.views)
        return f"gradients of {self.group} clipped from norm {self.norm:.3g} to {self.limit:.3g} (views {views})"


class StepSkipped(TrainingEvent):
    """The loss or a gradient was not finite; the parameters were left as they were."""

    kind: Literal["skipped"] = Field("skipped", description=KIND)
    non_finite: str = Field(description="What was not finite: the loss, or the gradient of a parameter.")
    views: tuple[str, ...] = Field(description="Views of the step.")
    times: tuple[float, ...] = Field(description="Normalised times of these views.")

    def _words(self) -> str:
        views = ", ".join(self.views)
        return f"step skipped: {self.non_finite} was not finite (views {views} at t = {_list(self.times)})"


class RolledBack(TrainingEvent):
    """Training went wrong and continues from an earlier state, with lower learning rates and another order of views."""

    kind: Literal["rolled_back"] = Field("rolled_back", description=KIND)
    to_iteration: int = Field(ge=0, description="Iteration of the run whose state was restored.")
    reason: str = Field(description="What went wrong, in plain words.")
    rate_factor: float = Field(gt=0, le=1, description="Factor on all learning rates from here on.")

    def _words(self) -> str:
        return (
            f"rolled back to iteration {self.to_iteration:,}: {self.reason}; "
            f"learning rates are {self.rate_factor:.3g} of their schedule from here on"
        )


class OpacityReset(TrainingEvent):
    """In a whole pass over the views nothing was drawn: opacities were raised."""

    kind: Literal["opacity_reset"] = Field("opacity_reset", description=KIND)
    opacity: float = Field(gt=0, lt=1, description="Opacity that the median Gaussian got.")
    shift: float = Field(description="What was added to all opacity logits.")

    def _words(self) -> str:
        return (
            f"opacities reset to {self.opacity} (logits {self.shift:+.3g}), because nothing was drawn in a whole pass "
            "over the views. With large motion, train with a smaller `time_window`."
        )


class Restarted(TrainingEvent):
    """A moving object was missing: training starts again with tracks of it, or on a part of the clip."""

    kind: Literal["restart"] = Field("restart", description=KIND)
    missing_share: float = Field(ge=0, le=1, description="Share of the checked training views in which it was missing.")
    time_window: float = Field(gt=0, le=1, description="Share of the clip that the new start begins with.")
    tracked_points: int = Field(0, ge=0, description="Points of the object whose way through the clip was found.")

    def _words(self) -> str:
        points, part = self.tracked_points, f"the middle {100 * self.time_window:.3g} % of the clip"
        start = f"{points} points that follow what moves" if points else part
        return f"training starts again with {start}: the model missed a moving object. `time_window=1` prevents this."


class Stiff(TrainingEvent):
    """The last optimiser steps were longer than the Gaussians they moved."""

    kind: Literal["stiff"] = Field("stiff", description=KIND)
    step_over_size: float = Field(
        gt=1, description="Length of a step over the size of the Gaussian it moved, 99th percentile."
    )

    def _words(self) -> str:
        return (
            f"the last steps still move Gaussians by {self.step_over_size:.3g} times their own size (99th percentile). "
            "Train longer, or with lower final `rates` of offsets, deformation and matrices."
        )


class Diverged(TrainingEvent):
    """Training went wrong once more than it may roll back, and ended."""

    kind: Literal["diverged"] = Field("diverged", description=KIND)
    reason: str = Field(description="What went wrong, in plain words.")

    def _words(self) -> str:
        return self.reason


Event = Annotated[
    BackgroundFound
    | PointsInitialized
    | TimeWindowStarted
    | LowResolutionStarted
    | MotionFound
    | Grew
    | GrowthCapped
    | Pruned
    | Unseen
    | Thinned
    | GrowthQuiet
    | PartDropped
    | GradientsClipped
    | StepSkipped
    | RolledBack
    | OpacityReset
    | Restarted
    | Stiff
    | Diverged,
    Field(discriminator="kind"),
]


def _list(numbers: tuple[float, ...]) -> str:
    return ", ".join(f"{number:.4g}" for number in numbers)
