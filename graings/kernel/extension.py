"""The compiled extension, built from `csrc/`, and the instruction set it uses.

Other modules access the extension through `kernel()`, which raises an error with a remedy if it cannot be loaded, or
through `call`.
"""

from __future__ import annotations

import importlib
from functools import cache
from types import ModuleType
from typing import Any

from torch import Tensor

from graings.errors import KernelError


def keep_freed_memory() -> None:
    """Make the C library keep freed memory for the next step instead of returning it; no effect without glibc.

    Every step allocates and frees the same tens of megabytes. Fetching them from the operating system page by page
    took a fifth of its time.
    """
    kernel().keep_freed_memory()


@cache
def kernel() -> ModuleType:
    """The extension module. Raises `KernelError` if it is not built or GRAINGS_ISA is not available here."""
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


def call(function: str, *arguments: Any) -> Any:
    """What a function of the extension returns. `arguments` may be tensors and lists of them, without gradients.

    Tensors are handed over as NumPy arrays of their memory. nanobind would ask each of them for a DLPack capsule, in
    Python: 7 microseconds instead of 2, and an image takes 45 tensors.
    """
    return getattr(kernel(), function)(*map(_handed_over, arguments))


def _handed_over(argument: Any) -> Any:
    if isinstance(argument, Tensor):
        return argument.numpy()
    return [_handed_over(one) for one in argument] if isinstance(argument, list) else argument


def active_isa() -> str:
    """Name of the instruction set in use: avx512, avx2 or generic."""
    return str(kernel().active_isa())


def available_isas() -> tuple[str, ...]:
    """Instruction sets this CPU can run, best first."""
    return tuple(kernel().available_isas())


def has_bfloat16_products() -> bool:
    """Whether networks can have products in bfloat16 here: with AMX, and where avx512 is the instruction set in use."""
    return bool(kernel().has_bfloat16_products())


def use_isa(name: str) -> None:
    """Select an instruction set for the whole process. Raises `ValueError` if it cannot run on this CPU."""
    kernel().use_isa(name)
