"""TrainConfig: all options of one training run."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field, model_validator

from graings.config.optimization import DensityConfig, EvaluationConfig, GuardConfig, RatesConfig
from graings.config.plan_options import PlanConfig
from graings.config.presets import PAPER_ITERATIONS, PRESETS
from graings.config.sections import CaptureConfig, ConfigSection, InitConfig, LossConfig, SceneConfig


class TrainConfig(ConfigSection):
    """All options of a training run."""

    preset: Literal["draft", "standard", "fine", "long", "paper"] = Field(
        "standard", description="Name of the set of defaults that the other options change."
    )
    iterations: int = Field(5_000, ge=1, le=1_000_000, description="Number of optimisation steps.")
    batch: int = Field(
        4,
        ge=1,
        le=64,
        description="Views per optimisation step, each at its own time. Time-independent network outputs are computed "
        "once per step, and learning rates are multiplied by the cube root of the batch.",
    )
    warmup: int = Field(
        1_000,
        ge=0,
        lt=PAPER_ITERATIONS,
        description="Length of the static warm-up T_w, in a schedule of 30 000; the paper has 3 000.",
    )
    average_from: int = Field(
        29_000,
        ge=0,
        description="Iteration, in a schedule of 30 000, after which parameters are averaged, once growth and pruning "
        "have ended; the trained model is this average. 30000: no averaging.",
    )
    time_window: float | None = Field(
        None,
        gt=0,
        le=1,
        description="Fraction of the clip, around its middle, whose views training starts with; 1: all. null: the "
        "largest fraction in which the masks of all times overlap, which is 1 for most clips; if a moving object is "
        "missing later, training restarts with a smaller one.",
    )
    time_window_until: int = Field(
        7_500,
        ge=0,
        le=PAPER_ITERATIONS,
        description="Iteration, in a schedule of 30 000, at which the time window covers the whole clip.",
    )
    low_resolution_until: int = Field(
        0,
        ge=0,
        le=PAPER_ITERATIONS,
        description="Iteration, in a schedule of 30 000, until which training uses reduced images: half of each side, "
        "a quarter before that, and so on, as long as 200 px remain. 0: full resolution from the start.",
    )
    matrix_optimizer: Literal["muon", "adam"] = Field(
        "muon",
        description="Optimizer of the hidden weight matrices of StaticMLP and DeformNet. muon: orthogonalised "
        "momentum; adam: Adam, as for all other parameters.",
    )
    network_precision: Literal["auto", "bfloat16", "float32"] = Field(
        "auto",
        description="Precision of the factors of the networks' products in training. bfloat16: rounded, summed in "
        "float32, two to three times as fast; an error where the CPU has no AMX. "
        "auto: bfloat16 where the CPU has it, else float32. Evaluation and rendering always use float32.",
    )
    seed: int = Field(0, ge=0, lt=2**31, description="Seed of all random streams.")
    threads: int | None = Field(None, ge=1, le=256, description="Number of CPU threads; null: all cores.")
    capture: CaptureConfig = CaptureConfig()
    scene: SceneConfig = SceneConfig()
    init: InitConfig = InitConfig()
    loss: LossConfig = LossConfig()
    density: DensityConfig = DensityConfig()
    rates: RatesConfig = RatesConfig()
    guard: GuardConfig = GuardConfig()
    evaluation: EvaluationConfig = EvaluationConfig()
    plan: PlanConfig = PlanConfig()

    @model_validator(mode="before")
    @classmethod
    def _fill_from_preset(cls, values: Any) -> Any:
        """Fills values that are not given from the preset, so that its name always matches the defaults."""
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
        """The iteration of this run at a mark of the schedule of 30 000 iterations."""
        return round(mark * self.iterations / PAPER_ITERATIONS)
