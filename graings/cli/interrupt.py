"""Interrupt: Ctrl-C as a question that a loop asks between two steps.

A step that is cut in half cannot be resumed bit for bit, so the first signal only waits to be noticed; a second
one ends the process at once. Knows nothing of training.

The answer to a signal goes past all buffers: it may have come in the middle of a print, and printing within printing is
an error that would end what was only to be paused.
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
    """A context in the main thread; `received` is the first signal that came, or None. It is answered by `answer`."""

    def __init__(self, answer: str) -> None:
        self.received: int | None = None
        self._answer = f"\n{answer}\n".encode()
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
        """What a shell calls a process that ended by this signal."""
        return 128 + (self.received or 0)

    def _note(self, number: int, frame: FrameType | None) -> None:
        self.received = number
        self._restore()
        with contextlib.suppress(OSError):  # Ctrl-C ends the `tee` behind us too: who is not heard still stops in order
            os.write(STDERR, self._answer)

    def _restore(self) -> None:
        while self._before:
            number, handler = self._before.popitem()
            signal.signal(number, handler)
