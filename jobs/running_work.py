"""RunningWork: the jobs, messages and tasks that a worker runs."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager


class RunningWork:
    """Ids of the work that is running. Thread-safe.

    A job that was cancelled and resumed is taken again while its last run still stops: runs are counted.
    """

    def __init__(self) -> None:
        self._runs: Counter[str] = Counter()
        self._lock = threading.Lock()

    @contextmanager
    def running(self, entry: str) -> Iterator[None]:
        """A context that is one run of `entry`."""
        with self._lock:
            self._runs[entry] += 1
        try:
            yield
        finally:
            with self._lock:
                self._runs[entry] -= 1
                if not self._runs[entry]:
                    del self._runs[entry]

    def ids(self) -> frozenset[str]:
        """What has at least one run at the moment."""
        with self._lock:
            return frozenset(self._runs)
