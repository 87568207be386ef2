"""Terminal: lines of text for people."""

from __future__ import annotations

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.status import Status
from rich.text import Text

from graings.evaluation.metrics import SplitMetrics
from graings.evaluation.motion import MotionMetrics


def print_line(text: str) -> None:
    """Print a line without markup and wrapping."""
    Console().print(Text(text), soft_wrap=True)


def task_progress() -> Progress:
    """A bar with count and time left for each task, as a context; nothing is shown where there is no terminal."""
    console = Console()
    columns = (TextColumn("{task.description}"), BarColumn(bar_width=None), MofNCompleteColumn(), TimeRemainingColumn())
    return Progress(*columns, console=console, expand=True, disable=not console.is_terminal)


def busy_status(text: str) -> Status:
    """A context that shows `text` and a spinner on a terminal; nothing elsewhere."""
    return Console().status(Text(text, style="dim"))


def metrics_line(split: str, metrics: SplitMetrics) -> str:
    """The means of a split as one line."""
    if metrics.psnr is None:
        return f"{split}: {metrics.reason}"
    lpips, flip = metrics.lpips_vgg, metrics.flip_ldr
    quality = f"{split}: PSNR {metrics.psnr:.2f} dB, SSIM {metrics.ssim_3dgs:.4f}, {len(metrics.views)} views"
    known = [f"{name} {value:.4f}" for name, value in (("LPIPS", lpips), ("FLIP", flip)) if value is not None]
    missing = [f"no LPIPS: {metrics.lpips_reason}"] if lpips is None else []
    missing += [f"no FLIP: {metrics.flip_reason}"] if flip is None else []
    return "; ".join([", ".join([quality, *known]), *missing])


def motion_line(motion: MotionMetrics) -> str:
    """The error of tracked points as one line."""
    return (
        f"motion: {motion.points} points at {motion.times} times, off by {motion.mean:.2%} of the extent on average, "
        f"90 % of them by less than {motion.percentile_90:.2%} (without any motion {motion.mean_at_rest:.2%})"
    )
