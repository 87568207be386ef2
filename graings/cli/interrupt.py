"""Interrupt: the first Ctrl-C is only recorded, so that a loop can stop between two steps; the second ends the process.

A step that is cut in half could not be resumed bit for bit.
"""

from __future__ import annotations

import contextlib
import os
import signal
from types import FrameType, TracebackType
from typing import Any

SIGNALS = (signal.SIGINT, signal.SIGTERM)

STDERR = 2


class Interrupt:
    """A context in the main thread; `received` is the first signal, or None. It is confirmed with `message`."""

    def __init__(self, message: str) -> None:
        self.received: int | None = None
        self._message = f"\n{message}\n".encode()
        self._before: dict[int, Any] = {}

    def __enter__(self) -> Interrupt:
        self._before = {number: signal.signal(number, self._note) for number in SIGNALS}
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._restore()

    @property
    def exit_code(self) -> int:
        """The exit code of a process that this signal ended."""
        return 128 + (self.received or 0)

    def _note(self, number: int, frame: FrameType | None) -> None:
        self.received = number
        self._restore()
        # Without buffers: the signal may interrupt a print, and a print within a print raises an error. If Ctrl-C also
        # ended a `tee` that reads our output, the write fails, and training still stops at a checkpoint.
        with contextlib.suppress(OSError):
            os.write(STDERR, self._message)

    def _restore(self) -> None:
        while self._before:
            number, handler = self._before.popitem()
            signal.signal(number, handler)
