"""Whether training has missed a moving object: it is large in many views and the model does not show it.

Training finds an object with large motion only within a short part of the clip (`time_window`). In front of a textured
floor or room its masks do not tell, before the first step, how far it moves; the model after part of the steps does.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from graings.capture.capture import Frame
from graings.capture.images import ImageStore
from graings.config import TrainConfig
from graings.render import render
from graings.scene.scene import Scene
from graings.training.curriculum.time_window import TimeWindow
from graings.training.initialization.visual_hull import MIN_VIEWS

# Mark of the 30 000 schedule at which to look: later than the slowest of the clips looked at had found what they show.
CHECK_AT: Final = 12_500

# After fewer steps even what stays in place may not have been found; a run whose mark comes earlier is not looked at.
MIN_STEPS: Final = 400

# Training views to look at.
VIEWS: Final = 60

# Above this share of the views something is lost. Of seven clips that train well none has more than a thirtieth; three
# in which balls are lost have 0.5 and more.
MAX_MISSING_FRACTION: Final = 0.3

# Shares of the clip to begin again with: the first that has enough views.
RESTART_WINDOWS: Final = (0.1, 0.25)

# A picture's longer side in cells; a thing is as large as this many of them each way, and lost where the colour of each
# is wrong by this much in the mean. Rims and limbs that lag behind are thinner.
CELLS: Final = 50
BLOCK: Final = 3
COLOR_DIFFERENCE: Final = 0.3


def look_at(config: TrainConfig) -> int | None:
    """The iteration of an attempt after which to look, None where it has too few."""
    mark = config.scaled(CHECK_AT)
    return mark if mark >= MIN_STEPS else None


def restart_window(config: TrainConfig, times: Sequence[float]) -> float | None:
    """The share of the clip to begin again with, None where none has enough views; those of training are at `times`."""
    for share in RESTART_WINDOWS:
        window = TimeWindow(config, times, share)
        if MIN_VIEWS <= sum(window.has(view, 0) for view in range(len(times))) < len(times):
            return share
    return None


def missing_fraction(scene: Scene, frames: Sequence[Frame], images: ImageStore, background: Sequence[float]) -> float:
    """Share of `frames` in which something that they show is lost."""
    lost = 0
    for frame in frames:
        drawn = render(scene, frame.camera, frame.time, background).color
        lost += has_missing_object(drawn, torch.from_numpy(images.rgb(frame)))
    return lost / len(frames)


def has_missing_object(drawn: Float[Tensor, "height width 3"], shown: Float[Tensor, "height width 3"]) -> bool:
    """Whether a block of `shown` is another colour in `drawn`, both in [0, 1]."""
    height, width, _ = shown.shape
    cell = max(1, max(height, width) // CELLS)
    difference = (drawn - shown).permute(2, 0, 1).unsqueeze(0)
    wrong = functional.avg_pool2d(difference, min(cell, height, width)).abs().amax(1, keepdim=True) > COLOR_DIFFERENCE
    if min(wrong.shape[-2:]) < BLOCK:
        return False
    return bool((functional.avg_pool2d(wrong.float(), BLOCK, stride=1) > 1 - 1e-6).any())
