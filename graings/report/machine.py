"""Machine: on which machine and with which versions a number was measured; no host name, user or path."""

from __future__ import annotations

import os
import platform
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
from pydantic import Field

import graings
from graings import kernel
from graings.document import Document
from graings.errors import KernelError

Fact = TypeVar("Fact", str, bool)


class MachineFacts(Document):
    """Processor, memory, system and threads of a measurement."""

    cpu: str = Field(description="Model name of the processor.")
    cores: int | None = Field(description="Logical cores of the machine.")
    usable_cores: int = Field(gt=0, description="Cores that this process may run on.")
    cpu_quota: float | None = Field(description="Cores' worth of time that a container may use; null without a limit.")
    ram_gb: float = Field(gt=0, description="Main memory in GB.")
    os: str = Field(description="Operating system and its release.")
    architecture: str = Field(description="Machine architecture, such as x86_64.")
    kernel_isa: str | None = Field(
        description="Instruction set of the compiled rasterizer; null where only the reference implementation runs."
    )
    bfloat16_products: bool | None = Field(
        description="Whether networks can train with products in bfloat16 (AMX); null without the compiled kernel."
    )
    torch_cpu_capability: str = Field(description="Instruction set that torch uses.")
    threads: int = Field(gt=0, description="CPU threads that were used.")


class VersionFacts(Document):
    """Versions of the software that computed a number."""

    graings: str = Field(description="Version of graings.")
    python: str = Field(description="Version of Python.")
    torch: str = Field(description="Version of torch.")
    numpy: str = Field(description="Version of NumPy.")
    commit: str | None = Field(
        description="Abbreviated commit of the checkout, with -dirty where files differ; null outside of a checkout."
    )


def machine_facts(threads: int | None = None) -> MachineFacts:
    """Facts about this machine and the threads of a run (None: the kernel's default)."""
    return MachineFacts(
        cpu=_cpu_model(),
        cores=os.cpu_count(),
        usable_cores=kernel.usable_cores(),
        cpu_quota=_cpu_quota(),
        ram_gb=round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9, 1),
        os=f"{platform.system()} {platform.release()}",
        architecture=platform.machine(),
        kernel_isa=_of_kernel(kernel.active_isa),
        bfloat16_products=_of_kernel(kernel.has_bfloat16_products),
        torch_cpu_capability=torch.backends.cpu.get_cpu_capability(),
        threads=threads if threads is not None else kernel.thread_count(),
    )


def version_facts() -> VersionFacts:
    """Versions of this installation, and the commit when the package runs from a checkout."""
    return VersionFacts(
        graings=graings.__version__,
        python=platform.python_version(),
        torch=str(torch.__version__),
        numpy=np.__version__,
        commit=_commit(Path(graings.__file__).resolve().parent.parent),
    )


def _of_kernel(fact: Callable[[], Fact]) -> Fact | None:
    """A fact about the compiled kernel, or None where only the reference implementation can draw."""
    try:
        return fact()
    except KernelError:
        return None


def _cpu_model() -> str:
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.is_file():
        for line in cpuinfo.read_text().splitlines():
            key, _, value = line.partition(":")
            if key.strip() == "model name":
                return value.strip()
    return platform.processor() or "unknown"


def _cpu_quota() -> float | None:
    """Cores' worth of time a container may use (control groups, version 2), or None without a limit."""
    limit = Path("/sys/fs/cgroup/cpu.max")
    if not limit.is_file():
        return None
    quota, period = limit.read_text().split()
    return None if quota == "max" else int(quota) / int(period)


def _commit(root: Path) -> str | None:
    """Abbreviated commit of the checkout at `root`, `-dirty` when files differ; None outside of one."""
    if not (root / ".git").exists():
        return None
    command = ["git", "-C", str(root), "describe", "--always", "--dirty", "--abbrev=12", "--exclude=*"]
    try:
        answer = subprocess.run(command, capture_output=True, text=True, timeout=10)
    except (OSError, subprocess.TimeoutExpired):
        return None  # no git on this machine
    return answer.stdout.strip() or None
