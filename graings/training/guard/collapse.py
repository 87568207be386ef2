"""Collapse: nothing of the scene is drawn any more, and what is not drawn gets no gradient to come back.

Where the opacity of all children has fallen to one grey level or below, training would stand still for good. It is
noticed after one pass over the training views and mended once, in the open; a second time the rates are to blame.
Knows nothing of cameras or images.
"""

from __future__ import annotations

import math
from typing import Any, Final

import torch
from jaxtyping import Float
from torch import Tensor, nn

from graings.scene.scene import Scene

# Below this share of the children in every step of a pass the scene has collapsed.
MIN_DRAWN_FRACTION: Final = 1e-3

# The score that the median child is given again: what children are born with.
RESET_OPACITY: Final = 0.1

# An empty picture that differs by up to this is about right: there is hardly anything to see.
MIN_LOSS: Final = 0.02


class Collapse:
    """What the steps of the current pass have shown, and whether a collapse was mended before.

    Call `observe` for each step; after one that ended a pass in which nothing was shown, `missed` says whether there
    was something to see.
    """

    def __init__(self) -> None:
        self.raised = False
        self.missed = False
        self._shown = 0.0
        self._difference = 0.0

    def observe(self, drawn: int, slots: int, difference: float, *, last_of_pass: bool) -> bool:
        """Record a step that drew `drawn` of `slots` children; True when the pass it ends has shown a collapse.

        `difference` is the largest photometric loss of its views.
        """
        self._shown = max(self._shown, drawn / max(slots, 1))
        if math.isfinite(difference):  # what is not is the guard's to judge
            self._difference = max(self._difference, difference)
        if not last_of_pass:
            return False
        collapsed, self.missed = self._shown < MIN_DRAWN_FRACTION, self._difference > MIN_LOSS
        self._shown = self._difference = 0.0
        return collapsed

    def state(self) -> dict[str, Any]:
        """Plain numbers to go on from."""
        return {"mended": self.raised, "shown": self._shown, "loss": self._difference}

    def load(self, state: dict[str, Any]) -> None:
        """Continue from what `state()` gave."""
        self.raised, self._shown, self._difference = bool(state["mended"]), float(state["shown"]), float(state["loss"])


def mean_logits(scene: Scene) -> Float[Tensor, "anchor child"]:
    """Opacity logits of every slot as no particular camera sees it.

    The mean direction stands for all views where opacity looks at it.
    """
    with torch.no_grad():
        still = torch.zeros_like(scene.scaffold.anchors)
        logits = scene.appearance.opacity_logits(scene.scaffold.features, still)
        return logits + scene.scaffold.opacity_offsets.unsqueeze(-1)


def raise_opacity(scene: Scene) -> float:
    """Shift the last bias of the opacity head so that the median score is `RESET_OPACITY`; returns the shift."""
    shift = math.atanh(RESET_OPACITY) - float(mean_logits(scene).median())
    last = scene.appearance.opacity[-1]
    assert isinstance(last, nn.Linear)
    with torch.no_grad():
        last.bias.add_(shift)
    return shift
