"""Plan: what this scene does not need, each with its reason.

Only decisions that lose nothing are taken by themselves here: what is left out could not have changed the
reachable pictures. Knows nothing of how the parts work.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Literal

from graings.capture.capture import Capture
from graings.config import TrainConfig

SCHEMA = "graings.plan/1"
NO_ALPHA = "the images have no alpha channel"


@dataclass(frozen=True, slots=True)
class Decision:
    """One component and what becomes of it. `kind` says why that is safe: the same function (exact), a
    function the rest can represent (representable), or the user's word (user)."""

    component: str
    decision: Literal["keep", "drop"]
    kind: Literal["exact", "representable", "user"]
    reason: str


@dataclass(frozen=True, slots=True)
class Plan:
    """The decisions for one capture and configuration."""

    decisions: tuple[Decision, ...]

    def drops(self, component: str) -> bool:
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

    def to_json(self) -> dict[str, Any]:
        """The plan as a JSON document."""
        return {"schema": SCHEMA, "decisions": [asdict(decision) for decision in self.decisions]}


def make_plan(capture: Capture, config: TrainConfig) -> Plan:
    """Decide what to leave out for `capture`."""
    instants = len(capture.times)
    decisions = []

    def decide(
        component: str, drop: bool, reason: str, kind: Literal["exact", "representable"] = "representable"
    ) -> None:
        decisions.append(Decision(component, "drop" if drop else "keep", kind, reason))

    single = instants == 1
    noun = "1 distinct training time" if single else f"{instants} distinct training times"
    if config.scene.deformation == "none":
        decisions.append(Decision("deformation", "drop", "user", "scene.deformation is none"))
    else:
        decide(
            "deformation", single, f"{noun}: {'the canonical state is the only state' if single else 'things may move'}"
        )
    if not config.scene.residual:
        decisions.append(Decision("residual", "drop", "user", "scene.residual is off"))
    else:
        decide(
            "residual", single, f"{noun}: {'the canonical colour can be any colour' if single else 'light may change'}"
        )
    static = single or config.scene.deformation == "none"
    decide("temporal_loss", static, "no pair of times" if static else f"{noun}", "exact")
    alone = config.batch == 1 or len(capture.train) == 1
    if config.loss.rigidity == 0:
        decisions.append(Decision("rigidity", "drop", "user", "loss.rigidity is 0"))
    else:
        reason = "nothing moves" if static else "one view a step" if alone else "neighbours move together"
        decide("rigidity", static or alone, reason, "exact")
    if config.loss.alpha == 0:
        decisions.append(Decision("alpha_loss", "drop", "user", "loss.alpha is 0"))
    else:
        masks = "the masks say what is solid" if capture.has_alpha else NO_ALPHA
        decide("alpha_loss", not capture.has_alpha, masks, "exact")
    cloud = capture.points is not None
    decide("random_points", cloud, "the capture brings its own points" if cloud else "no point cloud in the capture")
    where = "masks say where there is nothing" if capture.has_alpha else "nothing is where the background is seen"
    decide("carving", cloud, "no random points" if cloud else where, "exact")
    return Plan(tuple(decisions))
