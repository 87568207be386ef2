"""The compiled extension: the one place that imports it, and the instruction set it runs with.

`csrc/` is its source. Says what to do where it is not built or cannot run on this CPU.
"""

from __future__ import annotations

import importlib
from functools import cache
from types import ModuleType

from graings.errors import KernelError


def keep_freed_memory() -> None:
    """Have the C library keep freed memory for the next step instead of giving it back; no effect without glibc.

    A step frees and wants the same tens of megabytes again; fetching them from the system, page by page, took a
    fifth of its time.
    """
    kernel().keep_freed_memory()


@cache
def kernel() -> ModuleType:
    """The extension module. Raises `KernelError` when it is not built or GRAINGS_ISA asks for the impossible."""
    try:
        module = importlib.import_module("graings.kernel._kernel")
    except ImportError as error:
        raise KernelError(
            f"the compiled kernel cannot be loaded ({error}). Install the package: pip install -e . needs a C++20 "
            "compiler; graings.raster.reference is the slow alternative without one"
        ) from error
    try:
        module.active_isa()
    except ValueError as error:
        raise KernelError(f"GRAINGS_ISA: {error}") from error
    return module


def active_isa() -> str:
    """Name of the instruction set in use: avx512, avx2 or generic."""
    return str(kernel().active_isa())


def available_isas() -> tuple[str, ...]:
    """Instruction sets this CPU can run, best first."""
    return tuple(kernel().available_isas())


def use_isa(name: str) -> None:
    """Choose an instruction set for the whole process. Raises `ValueError` when it cannot run here."""
    kernel().use_isa(name)
