"""RequestLimits: how many requests a key may send, so that one client cannot take the service from the others."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Literal

from limits import RateLimitItemPerMinute
from limits.storage import MemoryStorage
from limits.strategies import MovingWindowRateLimiter

from service.problems import TooManyRequests

Kind = Literal["requests", "event streams"]


class RequestLimits:
    """How many requests a key may send in a minute and have open at once, counted in this process.

    Event streams stay open for hours and are counted apart, so that they do not take the place of short requests.
    """

    def __init__(self, per_minute: int, requests: int, streams: int) -> None:
        self._rate = RateLimitItemPerMinute(per_minute)
        self._limiter = MovingWindowRateLimiter(MemoryStorage())
        self._most: dict[Kind, int] = {"requests": requests, "event streams": streams}
        self._open: Counter[tuple[str, Kind]] = Counter()
        self._guard = threading.Lock()

    @contextmanager
    def counted(self, name: str, kind: Kind = "requests") -> Iterator[None]:
        """While a request of the key `name` is open. Raises `TooManyRequests`."""
        if not self._limiter.hit(self._rate, name):
            window = self._limiter.get_window_stats(self._rate, name)
            raise TooManyRequests("This key has sent too many requests in the last minute.", window.reset_time)
        with self._guard:
            if self._open[name, kind] >= self._most[kind]:
                raise TooManyRequests(f"This key has {self._most[kind]} open {kind}. Wait until one has ended.")
            self._open[name, kind] += 1
        try:
            yield
        finally:
            with self._guard:
                self._open[name, kind] -= 1
                if not self._open[name, kind]:
                    del self._open[name, kind]
