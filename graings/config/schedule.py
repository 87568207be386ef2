"""The schedule of a run: static warm-up, then joint training."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

from graings.config.train_config import TrainConfig

# Phases whose time counts as training time; evaluation and checkpoints are reported separately.
TRAINING_PHASES: Final = ("init", "warmup", "joint", "static")


@dataclass(frozen=True, slots=True)
class Phase:
    """Iterations `first` to `last` (inclusive, from 1); `temporal` enables the time-dependent networks."""

    name: Literal["warmup", "joint", "static"]
    first: int
    last: int
    temporal: bool


def phases(config: TrainConfig) -> tuple[Phase, ...]:
    """The schedule of a run: static warm-up then joint training, or one static phase."""
    scene = config.scene
    has_time = scene.residual or scene.single_mlp or scene.deformation != "none"
    if not has_time:
        return (Phase("static", 1, config.iterations, temporal=False),)
    warmup = config.scaled(config.warmup) if scene.canonical else 0
    joint = Phase("joint", warmup + 1, config.iterations, temporal=True)
    return (Phase("warmup", 1, warmup, temporal=False), joint) if warmup else (joint,)
