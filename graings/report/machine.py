"""Machine: on what and with what a number was measured.

Facts for metrics documents; no host name, no user, no paths. Knows nothing of what is measured.
"""

from __future__ import annotations

import os
import platform
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import torch

import graings
from graings import kernel
from graings.errors import KernelError


def machine_facts(threads: int | None = None) -> dict[str, Any]:
    """Processor, memory, system and the threads of a run (None: the kernel's default)."""
    return {
        "cpu": _cpu_model(),
        "cores": os.cpu_count(),
        "usable_cores": kernel.usable_cores(),
        "cpu_quota": _cpu_quota(),
        "ram_gb": round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9, 1),
        "os": f"{platform.system()} {platform.release()}",
        "architecture": platform.machine(),
        "kernel_isa": _kernel_isa(),
        "torch_cpu_capability": torch.backends.cpu.get_cpu_capability(),
        "threads": threads if threads is not None else kernel.thread_count(),
    }


def version_facts() -> dict[str, Any]:
    """Versions of what computes, and the commit when the package runs from a checkout."""
    return {
        "graings": graings.__version__,
        "python": platform.python_version(),
        "torch": str(torch.__version__),
        "numpy": np.__version__,
        "commit": _commit(Path(graings.__file__).resolve().parent.parent),
    }


def _kernel_isa() -> str | None:
    """Instruction set of the compiled kernel, or None where only the oracle can draw."""
    try:
        return kernel.active_isa()
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
        return None  # no git here: the version alone has to do
    return answer.stdout.strip() or None
