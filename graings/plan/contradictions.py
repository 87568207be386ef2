"""Contradictions: what a capture does not show, and options that contradict what was measured."""

from __future__ import annotations

from graings.config import TrainConfig
from graings.plan.capture_statistics import CaptureStatistics
from graings.plan.rules import MONOCULAR, single_time, unchanged


def nothing_shown(statistics: CaptureStatistics) -> list[str]:
    """A warning where the training images have one colour; else none."""
    if statistics.coverage > 0:
        return []
    return [
        f"the {statistics.examined} training images that were looked at show one colour and nothing else: there is "
        "nothing to learn, and high metrics say nothing."
    ]


def contradictions(statistics: CaptureStatistics, config: TrainConfig) -> tuple[str, ...]:
    """What the capture does not show, and options that contradict what was measured, with the number."""
    found = []
    one, still = single_time(statistics), unchanged(statistics)
    moves = statistics.times > 1 and statistics.change is not None and not still.holds
    if statistics.times > 1 and statistics.camera_motion != "fixed" and config.scene.deformation != "none":
        found.append(f"{MONOCULAR}. The deformation is kept.")
    if statistics.times > 1 and statistics.camera_motion == "fixed" and statistics.change is None:
        found.append("not every fixed camera could be looked at. The deformation is kept.")
    found += nothing_shown(statistics)
    if config.scene.deformation == "none" and moves:
        found.append(f"scene.deformation is none, but {still}: what moves will be blurred.")
    found += [
        f"plan.keep has the {part}, but {one}: it can only learn what the other parts do as well."
        for part in ("deformation", "residual")
        if part in config.plan.keep and one.holds
    ]
    if "deformation" in config.plan.keep and statistics.times > 1 and still.holds:
        found.append(f"plan.keep has the deformation, but {still}.")
    if "alpha_loss" in config.plan.keep and statistics.alpha != "varying":
        found.append(f"plan.keep has the alpha_loss, but alpha is {statistics.alpha} in all examined images.")
    return tuple(found)
