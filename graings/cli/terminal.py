"""Terminal: lines of text for people."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rich.console import Console
from rich.status import Status
from rich.text import Text


def print_line(text: str) -> None:
    """Print a line without markup and wrapping."""
    Console().print(Text(text), soft_wrap=True)


def busy_status(text: str) -> Status:
    """A context that shows `text` and a spinner on a terminal; nothing elsewhere."""
    return Console().status(Text(text, style="dim"))


def metrics_line(split: str, metrics: Mapping[str, Any]) -> str:
    """The means of a split as one line; `metrics` is one of the splits of a metrics document."""
    if metrics["psnr"] is None:
        return f"{split}: {metrics['reason']}"
    lpips = metrics["lpips_vgg"]
    rest = f"LPIPS {lpips:.4f}" if lpips is not None else f"no LPIPS: {metrics['lpips_reason']}"
    views = len(metrics["views"])
    return f"{split}: PSNR {metrics['psnr']:.2f} dB, SSIM {metrics['ssim_3dgs']:.4f}, {views} views; {rest}"
