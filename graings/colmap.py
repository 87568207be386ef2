"""import_pycolmap: pycolmap, an optional extra, without what its import does to the process.

Its logging library installs a handler of its own for SIGTERM, which prints a stack trace and ends the process: a
training that was asked to stop would leave no checkpoint.
"""

from __future__ import annotations

import signal
import threading
from types import ModuleType


def import_pycolmap() -> ModuleType:
    """The module; the handler of SIGTERM stays what it was. Raises `ImportError` where pycolmap is not installed."""
    main_thread = threading.current_thread() is threading.main_thread()
    before = signal.getsignal(signal.SIGTERM)
    import pycolmap

    pycolmap.logging.minloglevel = pycolmap.logging.Level.ERROR.value  # it logs every start and every step
    if main_thread and before is not None:  # None: installed outside of Python
        signal.signal(signal.SIGTERM, before)
    return pycolmap
