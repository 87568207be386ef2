"""Work and precision: from the metrics of a run to its part of a work-precision report.

Held-out error against seconds, iterations and Gaussians, the time to given decibels, and where the seconds went. A
target that was not reached is null with its reason; phases that do not add up are reported as a problem.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Final, Literal

from graings.config import TrainConfig
from graings.config.schedule import TRAINING_PHASES
from graings.errors import CheckpointError
from graings.evaluation.metrics import SplitMetrics
from graings.report.formatting import duration
from graings.report.metrics_document import EvaluationPoint, Metrics, read_metrics
from graings.report.work_precision_document import (
    ErrorFloor,
    FinalMetrics,
    HeldOutReference,
    PhaseTimes,
    TimeToPsnr,
    Totals,
    TrainedRun,
    TrainingPart,
)
from graings.storage.run_folder import METRICS_FILE

TARGETS_DB: Final = (20.0, 25.0, 30.0, 35.0, 40.0)

# Phases may differ from the wall clock by this share before the report calls them inconsistent.
TOLERANCE: Final = 0.02

# Held-out photographs have 8 bits: rounding alone is an error of 1 / (255 sqrt 12).
QUANTISATION_RMSE: Final = 1 / (255 * math.sqrt(12))

HELD_OUT_REFERENCE: Final = HeldOutReference(
    what="held-out photographs of the split val, rounded to 8 bits",
    psnr="mean over views of -20 log10 RMSE, in dB",
    rmse="square root of the mean squared error over all views; at most as many dB as psnr",
    floor=ErrorFloor(quantisation_rmse=QUANTISATION_RMSE),
)


def read_run(path: Path) -> Metrics:
    """The metrics of a run folder, or of a `metrics.json` itself.

    Raises `CheckpointError` naming the file, the first field that does not fit, and a remedy.
    """
    file = path if path.is_file() else path / METRICS_FILE
    if not file.exists():
        raise CheckpointError(f"{file}: not found. Give the folder of a run that has been evaluated at least once.")
    return read_metrics(file)


def named_folder(run: Path) -> Path:
    """The folder that a run is named after: its own, or that above `run`, as all runs of jobs are called."""
    return run.parent if run.name == "run" and run.parent.name else run


def run_names(paths: Sequence[Path]) -> list[str]:
    """The shortest ends of `paths` that tell the runs apart. Raises `ValueError` when one is given twice."""
    folders = [path.resolve() for path in paths]
    folders = [path.parent if path.is_file() else path for path in folders]
    folders = [named_folder(path) for path in folders]
    twice = next((path for path in folders if folders.count(path) > 1), None)
    if twice is not None:
        raise ValueError(f"{twice} is given twice")
    length = 1
    while True:
        names = ["/".join(path.parts[-length:]) for path in folders]
        if len(set(names)) == len(names):
            return names
        length += 1


def training_part(name: str, metrics: Metrics, config: TrainConfig | None = None) -> TrainingPart:
    """The part of the run `name`; `config` are its options, where they are known."""
    times = phase_times(metrics)
    return TrainingPart(
        run=_trained_run(name, metrics, config),
        capture=metrics.capture,
        machine=metrics.machine,
        versions=metrics.versions,
        phases=times,
        totals=Totals(
            train_s=metrics.train_s,
            train_cpu_s=metrics.train_cpu_s,
            evaluation_s=metrics.phases_s.get("evaluation", 0.0),
            checkpoint_s=metrics.phases_s.get("checkpoint", 0.0),
            total_s=times.total_s,
            iterations=metrics.iterations,
            gaussians=metrics.gaussians,
            anchors=metrics.anchors,
            bytes=metrics.bytes,
        ),
        points=metrics.curve,
        final={split: _without_views(values) for split, values in metrics.splits.items()},
        time_to_psnr=time_to_psnr(metrics.curve),
        events=metrics.events,
        stiffness=metrics.stiffness,
        reference=HELD_OUT_REFERENCE,
    )


def _trained_run(name: str, metrics: Metrics, config: TrainConfig | None) -> TrainedRun:
    status: Literal["finished", "unfinished"] = (
        "finished" if metrics.iterations >= metrics.iterations_planned else "unfinished"
    )
    return TrainedRun(
        name=name,
        status=status,
        preset=None if config is None else config.preset,
        iterations_planned=metrics.iterations_planned,
        seed=metrics.seed,
        hashes=metrics.hashes,
    )


def phase_times(metrics: Metrics) -> PhaseTimes:
    """Seconds of each phase beside the wall clock, and whether they add up to it within `TOLERANCE`."""
    seconds, total = metrics.phases_s, metrics.wall_s
    phase_sum = math.fsum(seconds.values())
    missing = total - phase_sum
    share = abs(missing) / total if total > 0 else 0.0
    trained = math.fsum(value for name, value in seconds.items() if name in TRAINING_PHASES)
    problems = []
    if share > TOLERANCE:
        problems.append(f"phases sum to {phase_sum:.4g} s, the total is {total:.4g} s: {share:.1%} apart")
    if abs(trained - metrics.train_s) > TOLERANCE * max(trained, metrics.train_s):
        problems.append(f"training phases sum to {trained:.4g} s, train_s is {metrics.train_s:.4g} s")
    return PhaseTimes(
        seconds=seconds,
        training=tuple(name for name in seconds if name in TRAINING_PHASES),
        sum_s=phase_sum,
        total_s=total,
        unaccounted_s=missing,
        unaccounted_share=share,
        tolerance=TOLERANCE,
        consistent=not problems,
        problems=tuple(problems),
    )


def time_to_psnr(points: Sequence[EvaluationPoint], targets: Sequence[float] = TARGETS_DB) -> tuple[TimeToPsnr, ...]:
    """When each of `targets` (dB) was first reached: training seconds, iteration and Gaussians.

    Between the two evaluations around the crossing, decibels are taken as linear in the logarithm of each. Never
    extrapolated: a target not reached is null with `censored_at_s`, one reached by the first evaluation is null with
    `at_most_s`, each with its reason.
    """
    return tuple(_crossing(points, target) for target in targets)


def _crossing(points: Sequence[EvaluationPoint], target: float) -> TimeToPsnr:
    if not points:
        return TimeToPsnr(target_db=target, reason="no held-out view was evaluated")
    index = next((i for i, point in enumerate(points) if point.psnr >= target), None)
    if index is None:
        best = max(point.psnr for point in points)
        reason = f"not reached: the best evaluation is {best:.2f} dB"
        return TimeToPsnr(target_db=target, censored_at_s=points[-1].train_s, reason=reason)
    after = points[index]
    if index == 0 or points[index - 1].train_s <= 0:
        return TimeToPsnr(target_db=target, at_most_s=after.train_s, reason="reached by the first evaluation")
    before = points[index - 1]
    share = (target - before.psnr) / (after.psnr - before.psnr)

    def between(low: float, high: float) -> float:
        start, end = math.log(max(low, 1e-9)), math.log(max(high, 1e-9))
        return math.exp(start + share * (end - start))

    return TimeToPsnr(
        target_db=target,
        train_s=between(before.train_s, after.train_s),
        iteration=round(between(before.iteration, after.iteration)),
        gaussians=round(between(before.gaussians, after.gaussians)),
    )


def pareto(costs: Sequence[float], errors: Sequence[float]) -> list[int]:
    """Indices, cheapest first, of the pairs for which no other pair has both a lower cost and a lower error."""
    front: list[int] = []
    for i in sorted(range(len(costs)), key=lambda i: (costs[i], errors[i])):
        if not front or errors[i] < errors[front[-1]]:
            front.append(i)
    return front


def summary(part: TrainingPart) -> str:
    """A training part in one line."""
    name, points = part.run.name, part.points
    if not points:
        return f"{name}: no held-out view was evaluated"
    last = points[-1]
    times = ", ".join(
        f"{entry.target_db:g} dB {duration(entry.train_s)}" for entry in part.time_to_psnr if entry.train_s is not None
    )
    ending = f"; time to {times}" if times else ""
    return (
        f"{name}: {last.psnr:.2f} dB after {duration(last.train_s)} of training "
        f"({duration(part.totals.train_cpu_s)} CPU time){ending}"
    )


def _without_views(split: SplitMetrics) -> FinalMetrics:
    return FinalMetrics(**split.model_dump(exclude={"views"}), n_views=len(split.views))
