"""Finished files on their way into the folder of the capture, where they replace nothing.

They are made in a folder of their own and then moved, in a fixed order. The last one says that all of them are made, so
a call that was interrupted between two moves knows which files in the capture's folder are its own.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from graings.errors import CaptureError


def is_finished(made: Path, names: Sequence[str]) -> bool:
    """Whether all of `names` have been made in the folder `made`; some of them may have been moved already."""
    return (made / names[-1]).exists()


def check_free(made: Path, target: Path, names: Sequence[str]) -> None:
    """Raise `CaptureError` where the folder `target` has one of `names` that was not moved there from `made`."""
    finished = is_finished(made, names)
    for name in names:
        moved = finished and not (made / name).exists()
        if os.path.lexists(target / name) and not moved:
            remedy = f"Choose another folder, or move {name} away."
            raise CaptureError(f"holds {name} already, which the capture would replace", file=target, remedy=remedy)


def take_back(made: Path, target: Path, names: Sequence[str]) -> None:
    """Undo the moves of an interrupted `place`, if `made` is finished; what was not moved stays."""
    if is_finished(made, names):
        for name in names:
            if not (made / name).exists() and (target / name).exists():
                (target / name).rename(made / name)


def place(made: Path, target: Path, names: Sequence[str]) -> None:
    """Move the files and folders `names` from `made` to `target`, in this order. Raises as `check_free`."""
    check_free(made, target, names)
    for name in names:
        if (made / name).exists():
            (made / name).rename(target / name)
