"""Progress of a training run: on a terminal a bar with speed, PSNR and time left, elsewhere a line per evaluation."""

from __future__ import annotations

import math
from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, Task, TextColumn
from rich.text import Text

from graings.report.metrics_document import EvaluationPoint
from graings.training.run_output import RunReport


class _TimeLeft(ProgressColumn):
    """Remaining iterations at the run's speed, in which evaluations do not count."""

    max_refresh = 0.5

    def render(self, task: Task) -> Text:
        speed = task.fields["speed"]
        if speed <= 0 or task.remaining is None:
            return Text("-:-- left", style="dim")
        minutes, seconds = divmod(round(task.remaining / speed), 60)
        hours, minutes = divmod(minutes, 60)
        clock = f"{hours}:{minutes:02d}:{seconds:02d}" if hours else f"{minutes}:{seconds:02d}"
        return Text(f"{clock} left", style="dim")


class TrainingProgress:
    """Shows the steps of a run; a context manager."""

    def __init__(self, console: Console, done: int, iterations: int) -> None:
        self._console = console
        self._bar = Progress(
            TextColumn("{task.description:>7}"),
            BarColumn(bar_width=None),
            MofNCompleteColumn(),
            TextColumn("{task.fields[speed]:.1f} it/s"),
            TextColumn("[bold]{task.fields[psnr]:.1f} dB"),
            TextColumn("{task.fields[gaussians]:,} Gaussians", style="dim"),
            TextColumn("{task.fields[anchors]:,} anchors", style="dim"),
            _TimeLeft(),
            console=console,
            expand=True,
            disable=not console.is_terminal,
        )
        self._task = self._bar.add_task(
            "load", total=iterations, completed=done, speed=0.0, psnr=0.0, gaussians=0, anchors=0
        )

    def __enter__(self) -> TrainingProgress:
        self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bar.stop()

    def show(self, step: RunReport) -> None:
        """Move the bar to `step`; print its evaluation and events as lines."""
        unknown = math.isnan(step.psnr)  # an earlier process took the step
        self._bar.update(
            self._task,
            description=step.phase,
            completed=step.iteration,
            total=step.iterations,
            speed=step.iterations_per_s,
            psnr=self._bar.tasks[0].fields["psnr"] if unknown else step.psnr,
            gaussians=step.gaussians,
            anchors=step.anchors,
        )
        if step.evaluation is not None:
            self._line(_evaluation(step.evaluation))
        for event in step.events:
            self._line(f"{event.iteration:>7,}  {event.message}")

    def note(self, text: str) -> None:
        """Print a line above the bar."""
        self._line(text)

    def _line(self, text: str) -> None:
        self._console.print(Text(text, style="dim"), soft_wrap=True)


def _evaluation(point: EvaluationPoint) -> str:
    return (
        f"{point.iteration:>7,}  held out {point.psnr:5.2f} dB  SSIM {point.ssim_3dgs:.4f}  "
        f"{point.train_s:,.0f} s  {point.gaussians:,} Gaussians  {point.anchors:,} anchors"
    )
