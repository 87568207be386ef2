"""Interrupt: Ctrl-C as a question that a loop asks between two steps.

A step that is cut in half cannot be resumed bit for bit, so the first signal only waits to be noticed; a second
one ends the process at once. Knows nothing of training.
"""

from __future__ import annotations

import signal
from collections.abc import Callable
from types import FrameType, TracebackType
from typing import Any

SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Interrupt:
    """A context in the main thread; `received` is the first signal that came, or None."""

    def __init__(self, announce: Callable[[], None]) -> None:
        self.received: int | None = None
        self._announce = announce
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
        self._announce()

    def _restore(self) -> None:
        while self._before:
            number, handler = self._before.popitem()
            signal.signal(number, handler)
