"""TrainConfig: all options of one training run."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field, model_validator

from graings.config.presets import PAPER_ITERATIONS, PRESETS
from graings.config.sections import (
    CaptureConfig,
    ConfigSection,
    DensityConfig,
    EvaluationConfig,
    GuardConfig,
    InitConfig,
    LossConfig,
    RatesConfig,
    SceneConfig,
)


class TrainConfig(ConfigSection):
    """One training run."""

    preset: Literal["draft", "standard", "fine", "paper"] = Field(
        "standard", description="Where the defaults come from."
    )
    iterations: int = Field(5_000, ge=1, le=1_000_000, description="Optimisation steps.")
    batch: int = Field(
        4,
        ge=1,
        le=64,
        description="Views per optimisation step, each at its own instant. What networks say of all instants alike is "
        "computed once a step, and rates rise by the cube root.",
    )
    warmup: int = Field(1_000, ge=0, description="Static warm-up T_w, of the 30 000 schedule; the paper has 3 000.")
    average_from: int = Field(
        29_000,
        ge=0,
        description="After this mark of the 30 000 schedule, and the last growth and pruning, parameters are averaged; "
        "training ends with their mean. 30000: never.",
    )
    time_window: float | None = Field(
        None,
        gt=0,
        le=1,
        description="Share of the clip, around its middle, whose views training begins with; 1 takes all. null: the "
        "widest in which what the masks show stays in place, which is all of most clips, and less, from the start once "
        "more, where training loses something all the same.",
    )
    time_window_until: int = Field(
        7_500, ge=0, description="Mark of the 30 000 schedule at which the window has widened to the whole clip."
    )
    low_resolution_until: int = Field(
        0,
        ge=0,
        description="Mark of the 30 000 schedule until which training looks at smaller pictures: a half of each side, "
        "or a quarter before, and so on, as long as 200 px remain. 0: never.",
    )
    matrix_optimizer: Literal["muon", "adam"] = Field(
        "muon",
        description="How weight matrices of StaticMLP and DeformNet step. muon: orthogonalised momentum; adam: as the "
        "rest.",
    )
    seed: int = Field(0, ge=0, lt=2**31, description="Seed of every random stream.")
    threads: int | None = Field(None, ge=1, le=256, description="CPU threads; null takes all cores.")
    capture: CaptureConfig = CaptureConfig()
    scene: SceneConfig = SceneConfig()
    init: InitConfig = InitConfig()
    loss: LossConfig = LossConfig()
    density: DensityConfig = DensityConfig()
    rates: RatesConfig = RatesConfig()
    guard: GuardConfig = GuardConfig()
    evaluation: EvaluationConfig = EvaluationConfig()

    @model_validator(mode="before")
    @classmethod
    def _fill_from_preset(cls, values: Any) -> Any:
        """What is not given is as in the preset that is, so that its name never stands over other values."""
        if not isinstance(values, dict):
            return values
        name = values.get("preset", "standard")
        preset = PRESETS.get(name, {}) if isinstance(name, str) else {}
        filled = dict(values)
        for key, default in preset.items():
            if isinstance(default, dict):
                given = filled.get(key, {})
                filled[key] = {**default, **given} if isinstance(given, dict) else given
            else:
                filled.setdefault(key, default)
        return filled

    def scaled(self, mark: int) -> int:
        """An iteration mark of the 30 000 schedule, in this run's iterations."""
        return round(mark * self.iterations / PAPER_ITERATIONS)
