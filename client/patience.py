"""Patience: for how long a service may fail before a client gives up."""

from __future__ import annotations

import time
from typing import Final

from client.answers import ClientError, RefusedError

PATIENCE_S: Final = 60.0  # a service that restarts is back sooner

# Another request is still open, the service is busy, or a proxy in front of it finds it restarting.
PASSING: Final = frozenset((408, 409, 429, 502, 503, 504))


class Patience:
    """Counts from the first failure after the last success, not from the last success: a quiet hour is no failure."""

    def __init__(self) -> None:
        self._error: ClientError | None = None
        self._since = 0.0

    def succeeded(self) -> None:
        self._error = None

    def failed(self, error: ClientError) -> None:
        if self._error is None:
            self._since = time.monotonic()
        self._error = error

    def check(self) -> None:
        """Raise the last failure where they go on for more than `PATIENCE_S`."""
        if self._error is not None and time.monotonic() - self._since > PATIENCE_S:
            raise self._error


def passes(error: ClientError) -> bool:
    """Whether the same request may succeed a little later."""
    return not isinstance(error, RefusedError) or error.status in PASSING
