"""RetryLimit: for how long failures may go on before a client gives up."""

from __future__ import annotations

import time
from typing import Final

from client.answers import ClientError, RefusedError

RETRY_FOR_S: Final = 60.0  # a service that restarts is back sooner

# Another request is still open, the service is busy, or a proxy in front of it finds it restarting.
TRANSIENT: Final = frozenset((408, 409, 429, 502, 503, 504))


class RetryLimit:
    """Counts from the first failure after the last success, not from the last success: a quiet hour is no failure.

    Refusals with one of the statuses `TRANSIENT` or `also` may be followed by a success; others are final.
    """

    def __init__(self, *also: int) -> None:
        self._transient = TRANSIENT | set(also)
        self._error: ClientError | None = None
        self._since = 0.0

    def succeeded(self) -> None:
        self._error = None

    def failed(self, error: ClientError) -> None:
        """Note a failure; raise one that is final."""
        if isinstance(error, RefusedError) and error.status not in self._transient:
            raise error
        if self._error is None:
            self._since = time.monotonic()
        self._error = error

    def check(self) -> None:
        """Raise the last failure where they have gone on for more than `RETRY_FOR_S`."""
        if self._error is not None and time.monotonic() - self._since > RETRY_FOR_S:
            raise self._error
