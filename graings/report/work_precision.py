"""WorkPrecision: what error was reached after what work, as one document over runs.

Reads the `metrics.json` of finished or cut-off runs and says what a reader wants to compare: held-out error against
seconds, iterations and Gaussians, the time to given decibels, and where the seconds went. What was not reached is null
with its reason; what does not add up is said, not hidden. Knows nothing of models or how runs are
trained.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from graings.config.schedule import TRAINING_PHASES
from graings.errors import CheckpointError
from graings.report.formatting import duration
from graings.report.report import METRICS_SCHEMA, read_metrics

SCHEMA: Final = "graings.work_precision/1"

TARGETS_DB: Final = (20, 25, 30, 35, 40)

# Phases may miss this share of the wall clock before the report says that they do not add up.
TOLERANCE: Final = 0.02

# Held-out photographs have 8 bits: rounding alone is an error of 1 / (255 sqrt 12).
QUANTISATION_RMSE: Final = 1 / (255 * math.sqrt(12))

POINT_KEYS: Final = ("iteration", "train_s", "total_s", "psnr", "rmse", "ssim_3dgs", "views", "gaussians", "anchors")

# What runs of earlier versions did not measure: null there.
LATER_POINT_KEYS: Final = ("train_cpu_s", "step_over_size", "subpixel_share")

_KEYS: Final = (
    *("splits", "train_s", "total_s", "phases_s", "iterations", "gaussians", "anchors", "bytes", "curve", "events"),
    *("capture", "machine", "versions", "seed", "hashes"),
)


def read_run(path: Path) -> dict[str, Any]:
    """The metrics of a run folder, or of a `metrics.json` itself.

    Raises `CheckpointError` naming the file, what is missing in it and what to do.
    """
    file = path if path.is_file() else path / "metrics.json"
    if not file.exists():
        raise CheckpointError(f"{file}: not found. Give the folder of a run that has been evaluated at least once.")
    metrics = read_metrics(file)
    if metrics.get("schema") != METRICS_SCHEMA:
        raise CheckpointError(
            f"{file}: schema {metrics.get('schema')!r}, expected {METRICS_SCHEMA!r}. Give a run that was trained here."
        )
    absent = [key for key in _KEYS if key not in metrics]
    absent += [
        f"curve[{i}].{key}" for i, p in enumerate(metrics.get("curve", ())) for key in POINT_KEYS if key not in p
    ]
    if absent:
        raise CheckpointError(f"{file}: {', '.join(absent[:4])} missing. Finish the training run with this version.")
    return metrics


def run_names(paths: Sequence[Path]) -> list[str]:
    """The shortest tails of `paths` that tell the runs apart. Raises `ValueError` when one is given twice."""
    folders = [path.resolve() for path in paths]
    folders = [path.parent if path.is_file() else path for path in folders]
    # The run of a job is called run/, whatever the job: the folder above it carries the job's id.
    folders = [path.parent if path.name == "run" and path.parent.name else path for path in folders]
    twice = next((path for path in folders if folders.count(path) > 1), None)
    if twice is not None:
        raise ValueError(f"{twice} is given twice")
    length = 1
    while True:
        names = ["/".join(path.parts[-length:]) for path in folders]
        if len(set(names)) == len(names):
            return names
        length += 1


def training_part(name: str, metrics: Mapping[str, Any], run: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """One run as a part of kind `training`; `run` is its `run.json`, where there is one."""
    points = [
        {key: point[key] for key in POINT_KEYS} | {key: point.get(key) for key in LATER_POINT_KEYS}
        for point in metrics["curve"]
        if point["psnr"] is not None
    ]
    config = (run or {}).get("config", {})
    wanted = config.get("iterations")
    finished = bool(metrics["splits"]) if wanted is None else metrics["iterations"] >= wanted
    spent = phases(metrics)
    return {
        "kind": "training",
        "run": {
            "name": name,
            "status": "finished" if finished else "unfinished",
            "preset": config.get("preset"),
            "iterations_wanted": wanted,
            "seed": metrics["seed"],
            "n_seeds": 1,
            "hashes": metrics["hashes"],
        },
        "capture": metrics["capture"],
        "machine": metrics["machine"],
        "versions": metrics["versions"],
        "phases": spent,
        "totals": {
            "train_s": metrics["train_s"],
            "train_cpu_s": metrics.get("train_cpu_s"),
            "evaluation_s": metrics["phases_s"].get("evaluation", 0.0),
            "checkpoint_s": metrics["phases_s"].get("checkpoint", 0.0),
            "total_s": spent["total_s"],
            "iterations": metrics["iterations"],
            "gaussians": metrics["gaussians"],
            "anchors": metrics["anchors"],
            "bytes": metrics["bytes"],
        },
        "points": points,
        "final": {split: _final(values) for split, values in metrics["splits"].items()},
        "time_to_psnr": time_to_psnr(points),
        "events": metrics["events"],
        "stiffness": metrics.get("stiffness"),
        "reference": {
            "what": "held-out photographs of the split val, rounded to 8 bits",
            "psnr": "mean over views of -20 log10 RMSE, in dB",
            "rmse": "square root of the mean squared error over all views; at most as many dB as psnr",
            "floor": {"quantisation_rmse": QUANTISATION_RMSE},
        },
    }


def phases(metrics: Mapping[str, Any]) -> dict[str, Any]:
    """Seconds of each phase beside the clock on the wall, and whether they add up to it within `TOLERANCE`.

    Runs of earlier versions carry no wall clock; their own total stands in, and `total_is` says so.
    """
    seconds = {name: float(value) for name, value in metrics["phases_s"].items()}
    total = float(metrics.get("wall_s") or metrics["total_s"])
    whole = math.fsum(seconds.values())
    missing = total - whole
    share = abs(missing) / total if total > 0 else 0.0
    trained = math.fsum(value for name, value in seconds.items() if name in TRAINING_PHASES)
    problems = []
    if share > TOLERANCE:
        problems.append(f"phases sum to {whole:.4g} s, the total is {total:.4g} s: {share:.1%} apart")
    if abs(trained - metrics["train_s"]) > TOLERANCE * max(trained, metrics["train_s"]):
        problems.append(f"training phases sum to {trained:.4g} s, train_s is {metrics['train_s']:.4g} s")
    return {
        "seconds": seconds,
        "training": [name for name in seconds if name in TRAINING_PHASES],
        "sum_s": whole,
        "total_s": total,
        "total_is": "wall clock" if metrics.get("wall_s") else "sum of the run's own clock",
        "unaccounted_s": missing,
        "unaccounted_share": share,
        "tolerance": TOLERANCE,
        "consistent": not problems,
        "problems": problems,
    }


def time_to_psnr(points: Sequence[Mapping[str, Any]], targets: Sequence[float] = TARGETS_DB) -> list[dict[str, Any]]:
    """When each of `targets` (dB) was first reached: training seconds, iteration and Gaussians.

    Between the two evaluations around the crossing, decibels are taken as linear in the logarithm of each. Never
    extrapolated: a target not reached is null with `censored_at_s`, one reached by the first evaluation is null with
    `at_most_s`, each with its reason.
    """
    return [_crossing(points, target) for target in targets]


def _crossing(points: Sequence[Mapping[str, Any]], target: float) -> dict[str, Any]:
    unknown = {"target_db": target, "train_s": None, "iteration": None, "gaussians": None}
    if not points:
        return {**unknown, "reason": "no held-out view was evaluated"}
    at = next((i for i, point in enumerate(points) if point["psnr"] >= target), None)
    if at is None:
        best = max(point["psnr"] for point in points)
        reason = f"not reached: the best evaluation is {best:.2f} dB"
        return {**unknown, "censored_at_s": points[-1]["train_s"], "reason": reason}
    after = points[at]
    if at == 0 or points[at - 1]["train_s"] <= 0:
        return {**unknown, "at_most_s": after["train_s"], "reason": "reached by the first evaluation"}
    before = points[at - 1]
    share = (target - before["psnr"]) / (after["psnr"] - before["psnr"])

    def between(key: str) -> float:
        low, high = math.log(max(before[key], 1e-9)), math.log(max(after[key], 1e-9))
        return math.exp(low + share * (high - low))

    return {
        "target_db": target,
        "train_s": between("train_s"),
        "iteration": round(between("iteration")),
        "gaussians": round(between("gaussians")),
    }


def pareto(costs: Sequence[float], errors: Sequence[float]) -> list[int]:
    """Indices, cheapest first, of the pairs that no other beats in one of cost and error without losing the other."""
    front: list[int] = []
    for i in sorted(range(len(costs)), key=lambda i: (costs[i], errors[i])):
        if not front or errors[i] < errors[front[-1]]:
            front.append(i)
    return front


def document(
    training: Sequence[Mapping[str, Any]], render: Sequence[Mapping[str, Any]], omissions: Sequence[str]
) -> dict[str, Any]:
    """The whole report: strict JSON values, one part per run and kind."""
    return {"schema": SCHEMA, "training": list(training), "render": list(render), "omissions": list(omissions)}


def summary(part: Mapping[str, Any]) -> str:
    """A part of kind `training` in one line."""
    name, points = part["run"]["name"], part["points"]
    if not points:
        return f"{name}: no held-out view was evaluated"
    last = points[-1]
    reached = [entry for entry in part["time_to_psnr"] if entry["train_s"] is not None]
    times = ", ".join(f"{entry['target_db']:g} dB {duration(entry['train_s'])}" for entry in reached)
    ending = f"; time to {times}" if times else ""
    computed = part["totals"]["train_cpu_s"]
    processors = "" if computed is None else f" ({duration(computed)} of processor)"
    return f"{name}: {last['psnr']:.2f} dB after {duration(last['train_s'])} of training{processors}{ending}"


def _final(split: Mapping[str, Any]) -> dict[str, Any]:
    """The metrics of a whole split without its list of views."""
    short = {key: value for key, value in split.items() if key != "views"}
    return {**short, "n_views": len(split["views"])}
