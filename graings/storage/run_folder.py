"""Run folder: names of its files, where its checkpoints are, which is the newest, and who may write them.

Separate from `graings.storage.checkpoint`, so that a look at the progress of a run does not import torch.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from graings.errors import CheckpointError
from graings.storage.locks import locked

RECORD_FILE = "run.json"
PLAN_FILE = "plan.json"
METRICS_FILE = "metrics.json"
CURVE_FILE = "curve.svg"
LOCK_FILE = ".training"
CHECKPOINTS = "checkpoints"
MODEL_FILE = "model.graings"  # the compact model
BEST = "best"
FACTS_FILE = "checkpoint.json"


def checkpoints(run: Path) -> list[Path]:
    """The complete checkpoints of a run folder, oldest first."""
    folder = run / CHECKPOINTS
    if not folder.is_dir():
        return []
    return sorted(p for p in folder.iterdir() if p.name.isdigit() and (p / FACTS_FILE).is_file())


def newest_checkpoint(run: Path) -> Path | None:
    """The newest complete checkpoint of a run folder, or None."""
    complete = checkpoints(run)
    return complete[-1] if complete else None


def newest_model(run: Path) -> Path | None:
    """Where the model of a run folder is: its newest complete checkpoint, else its compact file, else None."""
    compact = run / MODEL_FILE
    return newest_checkpoint(run) or (compact if compact.is_file() else None)


def best_checkpoint(run: Path) -> Path | None:
    """The checkpoint of the best held-out quality so far, or None; `newest_checkpoint` never returns this folder."""
    folder = run / CHECKPOINTS / BEST
    return folder if (folder / FACTS_FILE).is_file() else None


def check_unused(run: Path) -> None:
    """Raises `CheckpointError` when the folder holds a run."""
    if (run / RECORD_FILE).exists():
        raise CheckpointError(f"{run}: already holds a run. Resume it (--resume) or choose another folder.")


@contextmanager
def sole_trainer(run: Path) -> Iterator[None]:
    """Lock a run folder for one trainer. Raises `CheckpointError` when another process of this machine has the lock."""
    with locked(run / LOCK_FILE, wait=False) as free:
        if not free:
            raise CheckpointError(f"{run}: is being trained by another process. Wait for it, or stop it.")
        yield
