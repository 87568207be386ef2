"""pycolmap, an optional extra: its import without the side effects, and what to do where it is missing.

Its logging library installs a handler of its own for SIGTERM, which prints a stack trace and ends the process: a
training that was asked to stop would leave no checkpoint.
"""

from __future__ import annotations

import platform
import signal
import sys
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


def pycolmap_has_a_build() -> bool:
    """Whether there is a package of pycolmap for this machine. The extra `colmap` in pyproject.toml says the same."""
    return sys.platform != "linux" or platform.machine() == "x86_64"


def pycolmap_remedy() -> str:
    """The command that installs pycolmap, or that there is nothing to install."""
    if pycolmap_has_a_build():
        return "pip install 'graings[colmap]'"
    return f"pycolmap has no build for Linux on {platform.machine()}"
