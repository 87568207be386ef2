"""Plan: which components this scene does not need, each with its reason.

A component is left out only where it could not have changed the images that the model can produce.
"""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from graings.capture.capture import Capture
from graings.config import TrainConfig
from graings.document import Document

NO_ALPHA = "the images have no alpha channel"

Component = Literal["deformation", "residual", "temporal_loss", "rigidity", "alpha_loss", "random_points", "carving"]


class Decision(Document):
    """One component and what becomes of it."""

    component: Component = Field(description="Part of the model, the loss or the initialisation.")
    decision: Literal["keep", "drop"] = Field(description="Whether the component is used.")
    kind: Literal["exact", "representable", "user"] = Field(
        description="Why dropping it is safe. exact: it would compute the same; representable: the other components "
        "can represent its effect; user: an option asks for it."
    )
    reason: str = Field(description="The reason in plain words.")


class Plan(Document):
    """The decisions for one capture and configuration."""

    schema_name: Literal["graings.plan/1"] = Field(
        "graings.plan/1", alias="schema", description="Kind and version of this document."
    )
    decisions: tuple[Decision, ...] = Field(description="One decision per component.")

    def drops(self, component: Component) -> bool:
        """Whether `component` is left out."""
        return any(d.component == component and d.decision == "drop" for d in self.decisions)

    def apply(self, config: TrainConfig) -> TrainConfig:
        """The configuration without what the plan leaves out."""
        scene: dict[str, object] = {}
        loss: dict[str, object] = {}
        if self.drops("deformation"):
            scene["deformation"] = "none"
        if self.drops("residual"):
            scene["residual"] = False
        if self.drops("temporal_loss"):
            loss["temporal"] = 0.0
        if self.drops("rigidity"):
            loss["rigidity"] = 0.0
        if self.drops("alpha_loss"):
            loss["alpha"] = 0.0
        return config.model_copy(
            update={"scene": config.scene.model_copy(update=scene), "loss": config.loss.model_copy(update=loss)}
        )


def make_plan(capture: Capture, config: TrainConfig) -> Plan:
    """Decide what to leave out for `capture`."""
    decisions: list[Decision] = []

    def decide(
        component: Component, drop: bool, reason: str, kind: Literal["exact", "representable"] = "representable"
    ) -> None:
        decisions.append(Decision(component=component, decision="drop" if drop else "keep", kind=kind, reason=reason))

    def dropped_by_user(component: Component, reason: str) -> None:
        decisions.append(Decision(component=component, decision="drop", kind="user", reason=reason))

    instants = len(capture.times)
    single = instants == 1
    count = "1 distinct training time" if single else f"{instants} distinct training times"
    if config.scene.deformation == "none":
        dropped_by_user("deformation", "scene.deformation is none")
    else:
        reason = "the canonical state is the only state" if single else "objects may move"
        decide("deformation", single, f"{count}: {reason}")
    if not config.scene.residual:
        dropped_by_user("residual", "scene.residual is off")
    else:
        reason = "the canonical colour can be any colour" if single else "the light may change"
        decide("residual", single, f"{count}: {reason}")
    static = single or config.scene.deformation == "none"
    decide("temporal_loss", static, "no pair of times" if static else count, "exact")
    one_view = config.batch == 1 or len(capture.train) == 1
    if config.loss.rigidity == 0:
        dropped_by_user("rigidity", "loss.rigidity is 0")
    else:
        reason = "nothing moves" if static else "one view per step" if one_view else "neighbours move together"
        decide("rigidity", static or one_view, reason, "exact")
    if config.loss.alpha == 0:
        dropped_by_user("alpha_loss", "loss.alpha is 0")
    else:
        reason = "the masks show what is opaque" if capture.has_alpha else NO_ALPHA
        decide("alpha_loss", not capture.has_alpha, reason, "exact")
    cloud = capture.points is not None
    decide("random_points", cloud, "the capture has a point cloud" if cloud else "the capture has no point cloud")
    empty = "the masks show empty space" if capture.has_alpha else "background pixels show empty space"
    decide("carving", cloud, "no random points" if cloud else empty, "exact")
    return Plan(decisions=tuple(decisions))
