"""Precision of the factors of the networks' products in training."""

from __future__ import annotations

from graings import kernel
from graings.config import TrainConfig
from graings.errors import KernelError


def rounds_products(config: TrainConfig) -> bool:
    """Whether `config` rounds the factors of the networks' products to bfloat16 on this machine.

    Raises `KernelError` where it must and the CPU cannot.
    """
    if config.network_precision == "float32":
        return False
    available = kernel.has_bfloat16_products()
    if config.network_precision == "bfloat16" and not available:
        raise KernelError(
            "network_precision: this CPU has no AMX for products in bfloat16, or GRAINGS_ISA leaves it out. "
            "Use auto or float32"
        )
    return available
