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
from graings.scene.prepared import PreparedScene
from graings.scene.scene import Scene
from graings.training.curriculum.time_window import TimeWindow
from graings.training.initialization.visual_hull import MIN_VIEWS

# Mark of the 30 000 schedule at which to check: later than the slowest of the tested clips had found its objects.
CHECK_AT: Final = 12_500

# After fewer steps even static objects may not have been found; a run whose mark comes earlier is not checked.
MIN_STEPS: Final = 400

# Number of training views to check.
VIEWS: Final = 60

# Above this share of the views an object counts as missing. Seven clips that train well have at most 0.03; three in
# which a moving ball is missing have 0.5 and more.
MAX_MISSING_FRACTION: Final = 0.3

# Shares of the clip to restart with: the first that has enough views.
RESTART_WINDOWS: Final = (0.1, 0.25)

# The longer image side in cells. An object is missing where a block of BLOCK x BLOCK cells all differ in mean colour by
# more than COLOR_DIFFERENCE; silhouettes and limbs that are slightly misplaced are thinner.
CELLS: Final = 50
BLOCK: Final = 3
COLOR_DIFFERENCE: Final = 0.3


def check_iteration(config: TrainConfig) -> int | None:
    """The iteration after which to check; None where the run is too short."""
    mark = config.scaled(CHECK_AT)
    return mark if mark >= MIN_STEPS else None


def restart_window(config: TrainConfig, times: Sequence[float]) -> float | None:
    """The share of the clip to restart with, for training views at `times`; None where none has enough views."""
    for share in RESTART_WINDOWS:
        window = TimeWindow(config, times, share)
        if MIN_VIEWS <= sum(window.has(view, 0) for view in range(len(times))) < len(times):
            return share
    return None


def missing_fraction(scene: Scene, frames: Sequence[Frame], images: ImageStore, background: Sequence[float]) -> float:
    """Share of `frames` in which an object is missing from the render."""
    missing, prepared = 0, PreparedScene(scene)
    for frame in frames:
        render_ = render(prepared, frame.camera, frame.time, background).color
        image, valid = torch.from_numpy(images.rgb(frame)), images.valid(frame)
        if valid is not None:
            image = torch.where(torch.from_numpy(valid).unsqueeze(-1), image, render_)
        missing += has_missing_object(render_, image)
    return missing / len(frames)


def has_missing_object(render_: Float[Tensor, "height width 3"], image: Float[Tensor, "height width 3"]) -> bool:
    """Whether a block of `image` has another colour in the render, both in [0, 1]."""
    height, width, _ = image.shape
    cell = max(1, max(height, width) // CELLS)
    difference = (render_ - image).permute(2, 0, 1).unsqueeze(0)
    differs = functional.avg_pool2d(difference, min(cell, height, width)).abs().amax(1, keepdim=True) > COLOR_DIFFERENCE
    if min(differs.shape[-2:]) < BLOCK:
        return False
    return bool((functional.avg_pool2d(differs.float(), BLOCK, stride=1) > 1 - 1e-6).any())
