"""What is suspicious about a capture that loads: rules on its poses, times, points and pictures."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from graings.capture.capture import Capture, Frame
from graings.capture.number_in_name import number_in_name
from graings.inspection.consistency import Consistency
from graings.inspection.document import Finding, time_text
from graings.plan.capture_statistics import CaptureStatistics

Array = NDArray[np.float64]

# Points of which fewer than this share are in some picture are not those of these cameras.
MIN_SEEN: Final = 0.2
# A scene is rarely this much larger or smaller than 1 in its own unit, metres.
MAX_UNIT: Final = 1e3
# Below this share of matches a scene without motion has poses or times that do not fit its pictures.
POOR: Final = 0.2
# Share of the pairs of neighbouring file numbers whose times go back.
MAX_BACK: Final = 0.1
LONG_GAP: Final = 10.0  # times the median step between instants
MASKED: Final = 0.9


def findings(
    capture: Capture, statistics: CaptureStatistics, tested: Consistency, distance: float, masked: float
) -> tuple[Finding, ...]:
    """Everything suspicious. `distance`: of the median camera in the capture's unit; `masked`: share of the pixels."""
    found = [
        *_poses(capture, statistics, tested),
        *_points(capture),
        *_units(distance),
        *_times(capture, statistics),
        *_pictures(statistics),
    ]
    if masked > MASKED:
        found.append(
            Finding(
                about="masks",
                text=f"the masks hide {masked:.0%} of the pixels",
                remedy="Black is ignored and white is used: invert the masks if they show the object",
            )
        )
    return tuple(found)


def _poses(capture: Capture, statistics: CaptureStatistics, tested: Consistency) -> list[Finding]:
    if tested.other is not None and tested.share is not None:
        text = (
            f"the poses explain {tested.share:.0%} of the matches between pictures, but {tested.other_share:.0%} if "
            f"{tested.other}"
        )
        tagged = "are turned" in tested.other and any("EXIF" in note for note in capture.notes)
        remedy = "Set capture.orientation=upright." if tagged else "Export the poses as the format asks for."
        return [Finding(about="poses", text=text, remedy=remedy)]
    if tested.share is not None and tested.share < POOR and statistics.times == 1:
        text = f"the poses explain only {tested.share:.0%} of the matches between pictures of a static scene"
        return [Finding(about="poses", text=text, remedy="Check that poses and pictures belong together.")]
    return []


def _points(capture: Capture) -> list[Finding]:
    if capture.points is None:
        return []
    seen = np.zeros(len(capture.points.positions), np.bool_)
    for frame in capture.train:
        pixels, depths = frame.camera.project(capture.points.positions)
        inside = (pixels >= 0).all(axis=1) & (pixels < (frame.camera.width, frame.camera.height)).all(axis=1)
        seen |= inside & (depths > 0)
    if seen.mean() >= MIN_SEEN:
        return []
    text = f"only {seen.mean():.0%} of the {len(seen):,} points are in any picture: they have other axes or units"
    return [Finding(about="points", text=text, remedy="Export points and poses together, or leave the points out.")]


def _units(distance: float) -> list[Finding]:
    if distance == 0 or 1 / MAX_UNIT <= distance <= MAX_UNIT:
        return []
    text = f"the median camera is {distance:.3g} units from the centre, which is unusual for metres"
    remedy = "Training has its own unit, but views are asked for in the unit of the capture: check that it is meant."
    return [Finding(about="units", text=text, remedy=remedy)]


def _times(capture: Capture, statistics: CaptureStatistics) -> list[Finding]:
    found = []
    numbered = [(number_in_name(frame.name), frame.time) for frame in capture.train]
    if statistics.camera_motion == "moving" and statistics.times > 2 and all(n is not None for n, _ in numbered):
        steps = np.diff([time for _, time in sorted(numbered)])
        back = float((steps < 0).mean())
        if MAX_BACK < back < 1 - MAX_BACK:
            text = f"times do not ascend with the numbers of the file names: {back:.0%} of the steps go back"
            found.append(
                Finding(about="times", text=text, remedy="Check the times; with a shuffled clip motion is not smooth.")
            )
    steps = np.diff(capture.times)
    if len(steps) > 2 and steps.max() > LONG_GAP * np.median(steps):
        after = capture.units.time_start + capture.units.time_span * float(capture.times[int(steps.argmax())])
        factor, place = steps.max() / np.median(steps), time_text(after, capture.units.time_span)
        text = f"a gap of {factor:.0f} times the usual step follows the time {place}"
        found.append(Finding(about="times", text=text, remedy="Check that no part of the clip is missing."))
    return found


def _pictures(statistics: CaptureStatistics) -> list[Finding]:
    if statistics.coverage > 0:
        return []
    text = f"the {statistics.examined} training images that were looked at show one colour and nothing else"
    return [Finding(about="pictures", text=text, remedy="Check the export: there is nothing to learn from them.")]


def in_order(frames: Sequence[Frame]) -> list[Frame]:
    """`frames` as they were taken: by time, or by name where there is none."""
    return sorted(frames, key=lambda frame: (frame.time, frame.name))
