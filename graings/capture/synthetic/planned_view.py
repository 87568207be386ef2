"""Which views of a world a capture holds: cameras and times of every split."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

from graings.capture.synthetic.exact import uniform
from graings.capture.synthetic.viewpoint import Viewpoint, on_path, on_rig
from graings.capture.synthetic.world import World

RIG_CAMERAS: Final = 12


@dataclass(frozen=True, slots=True)
class PlannedView:
    """One image to draw; `name` is relative to the capture and has no extension."""

    name: str
    viewpoint: Viewpoint
    time: float


def planned_views(world: World, *, size: int, views: int, seed: int) -> dict[str, list[PlannedView]]:
    """The images of each split.

    `train` has `views` images, one per time, or as many instants of `RIG_CAMERAS` fixed cameras as fit. `val` and
    `test` look from other directions at training times; `between` looks from other directions at times in the middle
    of two training times, and is left out where there are fewer than two.
    """
    instants = {"moving": views, "rig": max(2, views // RIG_CAMERAS), "still": 1}[world.cameras]
    times = [index / max(instants - 1, 1) for index in range(instants)]
    starts = uniform(seed, "cameras", 4).tolist()
    result: dict[str, list[PlannedView]] = {}
    if world.cameras == "rig":
        cameras = [on_rig(world.path, index, RIG_CAMERAS, size) for index in range(RIG_CAMERAS)]
        result["train"] = [
            PlannedView(f"train/c{number:02d}_{index:03d}", camera, time)
            for number, camera in enumerate(cameras)
            for index, time in enumerate(times)
        ]
    else:
        result["train"] = [
            PlannedView(f"train/r_{index:03d}", on_path(world.path, index, starts[0], size), times[index % instants])
            for index in range(views)
        ]
    held_out = {"val": max(1, views // 10), "test": max(2, views // 8)}
    if instants > 1:
        held_out["between"] = max(2, views // 8)
    for number, (split, count) in enumerate(held_out.items(), start=1):
        between = split == "between"
        intervals = instants - 1 if between else instants
        result[split] = []
        for index in range(count):
            place = min(math.floor((index + 0.5) / count * intervals), intervals - 1)
            time = (place + 0.5) / (instants - 1) if between else times[place]
            viewpoint = on_path(world.path, index, starts[number], size)
            result[split].append(PlannedView(f"{split}/r_{index:03d}", viewpoint, time))
    return result
