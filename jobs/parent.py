"""Parent watch: notice that the parent process has ended.

The parent holds the other end of this process's standard input; the kernel closes it when the parent ends or is killed.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable


def watch_parent(on_death: Callable[[], None]) -> None:
    """Call `on_death` from a thread once standard input ends."""

    def watch() -> None:
        # os.read and not sys.stdin: a thread inside a buffered reader aborts the interpreter when it exits.
        while os.read(0, 1):
            pass
        on_death()

    threading.Thread(target=watch, name="parent-watch", daemon=True).start()
