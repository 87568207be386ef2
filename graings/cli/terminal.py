"""Terminal: lines of text for people."""

from __future__ import annotations

from rich.console import Console
from rich.status import Status
from rich.text import Text

from graings.evaluation.metrics import SplitMetrics
from graings.evaluation.motion import MotionMetrics


def print_line(text: str) -> None:
    """Print a line without markup and wrapping."""
    Console().print(Text(text), soft_wrap=True)


def busy_status(text: str) -> Status:
    """A context that shows `text` and a spinner on a terminal; nothing elsewhere."""
    return Console().status(Text(text, style="dim"))


def metrics_line(split: str, metrics: SplitMetrics) -> str:
    """The means of a split as one line."""
    if metrics.psnr is None:
        return f"{split}: {metrics.reason}"
    lpips = metrics.lpips_vgg
    rest = f"LPIPS {lpips:.4f}" if lpips is not None else f"no LPIPS: {metrics.lpips_reason}"
    return f"{split}: PSNR {metrics.psnr:.2f} dB, SSIM {metrics.ssim_3dgs:.4f}, {len(metrics.views)} views; {rest}"


def motion_line(motion: MotionMetrics) -> str:
    """The error of tracked points as one line."""
    return (
        f"motion: {motion.points} points at {motion.times} times, off by {motion.mean:.2%} of the extent on average, "
        f"90 % of them by less than {motion.percentile_90:.2%} (without any motion {motion.mean_at_rest:.2%})"
    )
