"""ParameterAverage: the mean of a scene's parameters over the last steps of a training.

The last steps fluctuate around an optimum; their mean is closer to it than any of them (Polyak and Juditsky 1992).
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from graings.scene.scene import Scene


class ParameterAverage:
    """Mean over the steps that were added; no anchor may be added or removed between them."""

    def __init__(self) -> None:
        self.steps = 0
        self._means: dict[str, Tensor] = {}

    @torch.no_grad()
    def add(self, scene: Scene) -> None:
        """Add the parameters as they are now."""
        self.steps += 1
        for name, parameter in scene.named_parameters():
            if self.steps == 1:
                self._means[name] = parameter.detach().clone()
            else:
                self._means[name].lerp_(parameter, 1 / self.steps)

    @torch.no_grad()
    def apply(self, scene: Scene) -> None:
        """Set the parameters to their means. Raises `ValueError` where no step was added."""
        if self.steps == 0:
            raise ValueError("no step was added")
        for name, parameter in scene.named_parameters():
            parameter.copy_(self._means[name])

    def state(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """Means by name, and facts as JSON."""
        return dict(self._means), {"steps": self.steps}

    def load(self, means: dict[str, Tensor], facts: dict[str, Any]) -> None:
        """Continue from what `state()` returned."""
        self._means = {name: mean.clone() for name, mean in means.items()}
        self.steps = int(facts["steps"])
