"""The compiled kernel and the instruction set it runs with.

One place that imports the extension and says what to do when it is absent or cannot run here. Knows nothing
of Gaussians.
"""

from __future__ import annotations

import importlib
from functools import cache
from types import ModuleType

from graings.errors import KernelError


@cache
def kernel() -> ModuleType:
    """The extension module. Raises `KernelError` when it is not built or GRAINGS_ISA asks for the impossible."""
    try:
        module = importlib.import_module("graings.raster._kernel")
    except ImportError as error:
        raise KernelError(
            f"the compiled rasterizer cannot be loaded ({error}). Install the package: pip install -e . needs a C++20 "
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
