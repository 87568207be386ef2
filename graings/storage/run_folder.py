"""Run folder: what a run says of itself, where its checkpoints lie, which is the newest, and who may write them.

Apart from `graings.storage.checkpoint`, so that reading the progress of a run loads no tensors.
"""

from __future__ import annotations

import fcntl
import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from graings.errors import CheckpointError

RECORD_FILE = "run.json"
LOCK_FILE = ".training"
CHECKPOINTS = "checkpoints"
MODEL_FILE = "model.graings"  # the model alone, small, as it is given away
BEST = "best"
FACTS_FILE = "checkpoint.json"


@dataclass(frozen=True, slots=True)
class Record:
    """What a run says of itself: its options as they were stored, where its capture lay, and that capture's hash."""

    config: Any
    capture: Path
    capture_hash: str


def read_record(run: Path) -> Record:
    """The record of a run folder. Raises `CheckpointError`."""
    file = run / RECORD_FILE
    try:
        facts = json.loads(file.read_text())
    except FileNotFoundError as error:
        raise CheckpointError(
            f"{run}: holds no run to resume or measure, for there is no {RECORD_FILE}. Give the folder of a run, not "
            "that of one of its checkpoints."
        ) from error
    except (OSError, ValueError) as error:
        raise CheckpointError(f"{file}: not readable ({error}). Train anew.") from error
    try:
        return Record(facts["config"], Path(facts["capture"]["path"]), facts["capture"]["hash"])
    except (KeyError, TypeError) as error:
        raise CheckpointError(f"{file}: is not what a run writes there ({error!r}). Train anew.") from error


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


def newest_model(run: Path) -> Path | None:
    """Where the model of a run folder lies: its newest whole checkpoint, or where there is none its compact file.

    None where there is neither.
    """
    compact = run / MODEL_FILE
    return newest_checkpoint(run) or (compact if compact.is_file() else None)


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
