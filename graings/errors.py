"""Errors caused by files, options, the machine or the optimisation; not by misuse of a function.

    GraingsError
    ├── CaptureError      a file of the capture is missing, broken or contradicts another
    ├── ConfigError       an option is unknown or out of range
    ├── CheckpointError   a run folder or checkpoint cannot be read or written
    ├── OutputError       no file can be written at the place that was named
    ├── KernelError       the compiled kernel is absent or cannot run on this CPU
    └── DivergedError     training cannot continue; the best model is kept as the newest checkpoint

Each message names the file or field and a remedy. Misuse by a caller raises a plain `ValueError`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

# Characters of a message: more only repeats what a file holds.
MAX_MESSAGE: Final = 2_000


def printable(text: str) -> str:
    """`text` as a terminal and a log may show it, whatever file it came from.

    What does not print, such as half of a surrogate pair or an escape sequence, is written as its number. Of a long
    text the middle is left out.
    """
    if not text.isprintable():
        text = "".join(c if c.isprintable() or c == "\n" else ascii(c)[1:-1] for c in text)
    return text if len(text) <= MAX_MESSAGE else f"{text[: MAX_MESSAGE // 2]} … {text[-MAX_MESSAGE // 2 :]}"


class GraingsError(Exception):
    """Base class of all errors a user can encounter. Its message is `printable`."""

    def __init__(self, message: str) -> None:
        super().__init__(printable(message))


class CaptureError(GraingsError):
    """A capture cannot be used as it is.

    `file` is the file concerned (relative to the capture where possible), `field` the key or image property in it,
    `remedy` what the user can do.
    """

    def __init__(self, problem: str, *, file: Path | str, field: str | None = None, remedy: str) -> None:
        self.problem = printable(problem)
        self.file = printable(str(file))
        self.field = None if field is None else printable(field)
        self.remedy = remedy
        where = self.file if field is None else f"{self.file}, {self.field}"
        super().__init__(f"{where}: {self.problem}. {remedy}")


class ConfigError(GraingsError):
    """An option is unknown, of the wrong type or out of range."""


class OutputError(GraingsError):
    """No file can be written at the place that was named."""


class CheckpointError(GraingsError):
    """A run folder or checkpoint cannot be read or written."""


class KernelError(GraingsError):
    """The compiled kernel is missing or does not run on this CPU."""


class DivergedError(GraingsError):
    """Training cannot continue; the best model so far is the newest checkpoint."""
