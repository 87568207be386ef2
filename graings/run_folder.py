"""Run folder: where the checkpoints of a run lie and which is the newest.

Apart from `graings.checkpoint` so that those who only ask how far a run got need no tensors. Knows nothing of what is
in a checkpoint.
"""

from __future__ import annotations

from pathlib import Path

CHECKPOINTS = "checkpoints"
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
