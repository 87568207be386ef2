"""StepReport: what one step of training did and what it cost."""

from __future__ import annotations

from dataclasses import dataclass

from graings.report.events import Event


@dataclass(frozen=True, slots=True)
class StepReport:
    """One step.

    `psnr` in dB is the mean over the training views of the step; `gaussians` is the number that any of them
    may show: with an opacity score above 1/255, also outside of the image.
    `seconds` are wall time, `cpu_s` CPU time of all threads of the process.
    """

    iteration: int
    iterations: int
    phase: str
    loss: float
    psnr: float
    gaussians: int
    anchors: int
    seconds: float
    cpu_s: float
    events: tuple[Event, ...] = ()
