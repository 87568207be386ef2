"""ExitCode: the exit statuses of the trainer process, after sysexits.h where it has a matching one."""

from __future__ import annotations

from enum import IntEnum


class ExitCode(IntEnum):
    """Exit status of `python -m jobs.trainer_process`. A negative status is the number of the signal that killed it."""

    DONE = 0
    """Training is complete; the metrics are written."""
    CRASHED = 1
    """An unexpected error; the log has the traceback. Tried once more."""
    USAGE = 2
    """Wrong arguments."""
    REFUSED = 65
    """The capture, the options or the checkpoint cannot be used; the message has the remedy. Not tried again."""
    STOPPED = 75
    """Stopped by SIGTERM, SIGINT or the end of the parent, at a checkpoint from which training can continue."""
    DIVERGED = 76
    """Training diverged and has used all its rollbacks; the best model is the newest checkpoint. Not tried again."""


OUT_OF_MEMORY = (-9, 137)
"""Statuses of a process killed by SIGKILL, which the kernel sends when memory runs out."""
