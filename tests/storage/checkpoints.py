"""Checkpoints of a tiny model."""

from __future__ import annotations

from pathlib import Path

import torch

from graings.storage.checkpoint import TrainingState, save_checkpoint
from graings.storage.model import Model


def save(model: Model, run: Path, iteration: int = 7, *, best: bool = False) -> Path:
    """Write a checkpoint of `model` to the run folder `run`; returns its folder."""
    return save_checkpoint(
        run,
        scene=model.scene,
        state=TrainingState({"moments": torch.ones(3)}, {"rates": [0.1]}),
        units=model.units,
        background=model.background,
        views=model.views,
        config=model.config,
        iteration=iteration,
        finished=True,
        best=best,
    )
