"""RequestLimits: how many requests a key may send, so that one client cannot take the service from the others."""

from __future__ import annotations

import threading
from collections import Counter

from limits import RateLimitItemPerMinute
from limits.storage import MemoryStorage
from limits.strategies import MovingWindowRateLimiter

from service.problems import TooManyRequests


class RequestLimits:
    """How many requests a key may send in a minute and have open at once, counted in this process."""

    def __init__(self, per_minute: int, at_once: int) -> None:
        self._rate = RateLimitItemPerMinute(per_minute)
        self._limiter = MovingWindowRateLimiter(MemoryStorage())
        self._at_once = at_once
        self._open: Counter[str] = Counter()
        self._guard = threading.Lock()

    def begin(self, name: str) -> None:
        """Count a request of a key. Raises `TooManyRequests`."""
        if not self._limiter.hit(self._rate, name):
            window = self._limiter.get_window_stats(self._rate, name)
            raise TooManyRequests("This key has sent too many requests in the last minute.", window.reset_time)
        with self._guard:
            if self._open[name] >= self._at_once:
                raise TooManyRequests(f"This key has {self._at_once} open requests. Wait until one has ended.")
            self._open[name] += 1

    def end(self, name: str) -> None:
        with self._guard:
            self._open[name] -= 1
            if not self._open[name]:
                del self._open[name]
