"""ExitCode: what the trainer process says with its exit status, after sysexits.h where that has a word for it."""

from __future__ import annotations

from enum import IntEnum


class ExitCode(IntEnum):
    """Exit status of `python -m jobs.trainer_process`. A negative status is the signal that killed it."""

    DONE = 0
    """Trained to the end; metrics are written."""
    CRASHED = 1
    """An error nobody foresaw; the log has the traceback. Tried once more."""
    USAGE = 2
    """Wrong arguments."""
    REFUSED = 65
    """The capture, the options or the checkpoint cannot be used; the message has the remedy. Never tried again."""
    BUSY = 73
    """Another process trains in this job folder. Tried once more."""
    STOPPED = 75
    """Asked to stop (SIGTERM, SIGINT or the parent died); a checkpoint is written and training can continue."""
    DIVERGED = 76
    """Training came apart once more than it may go back; the best model is the newest checkpoint. Never tried again."""


OUT_OF_MEMORY = (-9, 137)
"""Statuses of a process that the kernel killed, most likely for its memory."""
