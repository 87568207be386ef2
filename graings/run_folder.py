"""Run folder: where the checkpoints of a run lie, which is the newest, and who may write them.

Apart from `graings.checkpoint` so that those who only ask how far a run got need no tensors. Knows nothing of what is
in a checkpoint.
"""

from __future__ import annotations

import fcntl
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from graings.errors import CheckpointError

LOCK_FILE = ".training"
CHECKPOINTS = "checkpoints"
MODEL_FILE = "model.graings"  # the model alone, small, as it is given away
BEST = "best"
FACTS_FILE = "checkpoint.json"


def checkpoints(run: Path) -> list[Path]:
    """The whole checkpoints of a run folder, oldest first."""
    folder = run / CHECKPOINTS
    if not folder.is_dir():
        return []
    return sorted(p for p in folder.iterdir() if p.name.isdigit() and (p / FACTS_FILE).is_file())


def newest_checkpoint(run: Path) -> Path | None:
    """The newest whole checkpoint of a run folder, or None."""
    found = checkpoints(run)
    return found[-1] if found else None


def best_checkpoint(run: Path) -> Path | None:
    """The checkpoint of the best held-out quality so far, or None; `newest_checkpoint` never is this folder."""
    folder = run / CHECKPOINTS / BEST
    return folder if (folder / FACTS_FILE).is_file() else None


@contextmanager
def sole_trainer(run: Path) -> Iterator[None]:
    """Holds a run folder for this trainer. Raises `CheckpointError` when another process of this machine does."""
    with (run / LOCK_FILE).open("a") as handle:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise CheckpointError(f"{run}: is being trained by another process. Wait for it, or stop it.") from error
        yield
