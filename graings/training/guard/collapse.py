"""Collapse: no Gaussian is drawn any more, and without being drawn none gets a gradient.

Where the opacity of all children has fallen to 1/255 or below, training would stop for good. This is detected after
one pass over the training views; opacities are then raised once, with an event. A second collapse counts as divergence:
the learning rates are too high.
"""

from __future__ import annotations

import math
from typing import Any, Final

import torch
from jaxtyping import Float
from torch import Tensor, nn

from graings.scene.scene import Scene

# With less than this share of the children drawn in every step of a pass the scene has collapsed.
MIN_DRAWN_FRACTION: Final = 1e-3

# Opacity that the median child gets: as at initialization.
RESET_OPACITY: Final = 0.1

# Where an empty render has at most this photometric loss, the images are (nearly) empty themselves.
MIN_LOSS: Final = 0.02


class Collapse:
    """What was drawn in the current pass, and whether opacities were raised before.

    Call `observe` after each step; after the step that ends a pass with a collapse, `missed` tells whether the images
    were not empty.
    """

    def __init__(self) -> None:
        self.raised = False
        self.missed = False
        self._drawn = 0.0
        self._difference = 0.0

    def observe(self, drawn: int, slots: int, difference: float, *, last_of_pass: bool) -> bool:
        """Record a step that drew `drawn` of `slots` children; True when it ends a pass with a collapse.

        `difference` is the largest photometric loss of its views.
        """
        self._drawn = max(self._drawn, drawn / max(slots, 1))
        if math.isfinite(difference):  # the guard handles what is not
            self._difference = max(self._difference, difference)
        if not last_of_pass:
            return False
        collapsed, self.missed = self._drawn < MIN_DRAWN_FRACTION, self._difference > MIN_LOSS
        self._drawn = self._difference = 0.0
        return collapsed

    def state(self) -> dict[str, Any]:
        """Plain numbers to continue from."""
        return {"raised": self.raised, "drawn": self._drawn, "loss": self._difference}

    def load(self, state: dict[str, Any]) -> None:
        """Continue from what `state()` returned."""
        self.raised, self._drawn, self._difference = bool(state["raised"]), float(state["drawn"]), float(state["loss"])


def mean_logits(scene: Scene) -> Float[Tensor, "anchor child"]:
    """Opacity logits of every slot for the mean viewing direction, if opacity depends on it."""
    with torch.no_grad():
        mean_direction = torch.zeros_like(scene.scaffold.anchors)
        logits = scene.appearance.opacity_logits(scene.scaffold.features, mean_direction)
        return logits + scene.scaffold.slot_opacity_offsets


def raise_opacity(scene: Scene) -> float:
    """Shift the last bias of the opacity head so that the median opacity is `RESET_OPACITY`; returns the shift."""
    shift = math.atanh(RESET_OPACITY) - float(mean_logits(scene).median())
    last = scene.appearance.opacity[-1]
    assert isinstance(last, nn.Linear)
    with torch.no_grad():
        last.bias.add_(shift)
    return shift
