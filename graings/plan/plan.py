"""Plan: which parts this capture does not need, each with its evidence, and what the training will cost.

Decisions of the classes exact, representable and bounded are carried out. Estimated ones are proposed, and carried out
with `plan.mode=aggressive` only.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, Literal

from pydantic import Field

from graings.config import TrainConfig
from graings.document import Document
from graings.plan.capture_statistics import CaptureStatistics
from graings.plan.contradictions import contradictions
from graings.plan.cost import Calibration, Prediction, predict
from graings.plan.decision import Component, Decision, Saving
from graings.plan.rules import decide, has_preset_rate

# DeformNet also helps children to find their place. Without it, three captures of one time gain 0.15 to 0.18 dB with
# twice the first rate of the child offsets (docs/experiments/training-speed.md).
OFFSETS_FACTOR: Final = 2.0

# Parts of which leaving them out saves time that the calibration knows.
_COSTLY: tuple[Component, ...] = ("deformation", "residual")


class Plan(Document):
    """The decisions for one capture and configuration."""

    schema_name: Literal["graings.plan/1"] = Field(
        "graings.plan/1", alias="schema", description="Kind and version of this document."
    )
    mode: Literal["safe", "aggressive", "off"] = Field("safe", description="`plan.mode` of the options.")
    decisions: tuple[Decision, ...] = Field(description="One decision per component.")
    warnings: tuple[str, ...] = Field(
        (), description="What the capture does not show, and options that contradict a measurement, in plain words."
    )
    statistics: CaptureStatistics | None = Field(None, description="What was measured of the capture.")
    prediction: Prediction | None = Field(
        None, description="Expected cost of the training; null without a calibration of this machine."
    )
    alternatives: dict[str, Prediction] = Field(
        default_factory=dict, description="Expected cost with other presets, without other options."
    )

    def drops(self, component: Component) -> bool:
        """Whether `component` is left out."""
        return any(d.component == component and d.decision == "drop" for d in self.decisions)

    def decision(self, component: Component) -> Decision | None:
        """The decision about `component`; None where the plan has none."""
        return next((d for d in self.decisions if d.component == component), None)

    def revised(self, decision: Decision) -> Plan:
        """With another decision about the same component."""
        others = [decision if d.component == decision.component else d for d in self.decisions]
        return self.model_copy(update={"decisions": tuple(others)})

    def apply(self, config: TrainConfig) -> TrainConfig:
        """The configuration without what the plan leaves out."""
        return without(config, [d.component for d in self.decisions if d.decision == "drop" and d.iteration is None])


def without(config: TrainConfig, components: Sequence[Component]) -> TrainConfig:
    """`config` without some components. Those that no option switches are left as they are.

    Where this takes the deformation away, the first rate of the child offsets is multiplied by `OFFSETS_FACTOR`, unless
    `rates.offsets` is not that of the preset: an option that was set stays as it is.
    """
    scene: dict[str, object] = {}
    loss: dict[str, object] = {}
    rates: dict[str, object] = {}
    if "deformation" in components and config.scene.deformation != "none":
        scene["deformation"] = "none"
        first, last = config.rates.offsets
        if has_preset_rate(config):
            rates["offsets"] = OFFSETS_FACTOR * first, last
    if "residual" in components:
        scene["residual"] = False
    for component, weight in (("temporal_loss", "temporal"), ("rigidity", "rigidity"), ("alpha_loss", "alpha")):
        if component in components:
            loss[weight] = 0.0
    return config.model_copy(
        update={
            "scene": config.scene.model_copy(update=scene),
            "loss": config.loss.model_copy(update=loss),
            "rates": config.rates.model_copy(update=rates),
        }
    )


def make_plan(
    statistics: CaptureStatistics,
    config: TrainConfig,
    calibration: Calibration | None = None,
    alternatives: Sequence[TrainConfig] = (),
) -> Plan:
    """Decide what to leave out of training with `config`, and predict the cost of it and of `alternatives`."""
    decisions = tuple(_with_saving(d, statistics, config, calibration) for d in decide(statistics, config))
    plan = Plan(mode=config.plan.mode, decisions=decisions, statistics=statistics)
    warnings = contradictions(statistics, config)
    if calibration is None:
        return plan.model_copy(update={"warnings": warnings})
    costs = {
        one.preset: predict(statistics, make_plan(statistics, one).apply(one), calibration) for one in alternatives
    }
    prediction = predict(statistics, plan.apply(config), calibration)
    return plan.model_copy(update={"warnings": warnings, "prediction": prediction, "alternatives": costs})


def _with_saving(
    decision: Decision, statistics: CaptureStatistics, config: TrainConfig, calibration: Calibration | None
) -> Decision:
    """The decision with what leaving the part out saves against training with all costly parts."""
    if calibration is None or decision.component not in _COSTLY or decision.kind == "user":
        return decision
    whole = predict(statistics, config, calibration).cpu_s
    rest = predict(statistics, without(config, [decision.component]), calibration).cpu_s
    saved = max(0.0, whole - rest)
    saving = Saving(predicted_s=saved, predicted_share=min(1.0, saved / max(whole, 1e-9)))
    return decision.model_copy(update={"saving": saving})
