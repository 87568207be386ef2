"""DensityStatistics: what training observes of each child and anchor, on which growth and pruning decide."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from graings import constants


class DensityStatistics:
    """What was observed of each child and anchor since the last decision about it; float64 sums and int64 counts.

    `gradient` and `drawn` [A, k]: sum of NDC gradient norms and times drawn, per child. `opacity` and `visits`
    [A]: sum over visits of the summed positive child opacities, and visits: in view, or too faint to be drawn.
    """

    NAMES = ("gradient", "drawn", "opacity", "visits")

    def __init__(self, anchors: int, children: int) -> None:
        self.gradient = torch.zeros(anchors, children, dtype=torch.float64)
        self.drawn = torch.zeros(anchors, children, dtype=torch.int64)
        self.opacity = torch.zeros(anchors, dtype=torch.float64)
        self.visits = torch.zeros(anchors, dtype=torch.int64)

    def observe(
        self,
        children: Int64[Tensor, " gaussian"],
        screen_gradient: Float[Tensor, "gaussian 2"],
        visible: Bool[Tensor, " gaussian"],
        opacities: Float[Tensor, "anchor child"],
        size: tuple[int, int],
    ) -> None:
        """Record one view of a step.

        `children` are flat slots, `screen_gradient` is dL/d(mean in pixels), `visible` says which Gaussians
        touched the image of `size` (width, height), `opacities` are those of every slot.
        """
        # Adding zero for those that are not visible takes half the time of selecting the others.
        x, y = (screen_gradient[:, axis].double() * (size[axis] / 2.0) for axis in (0, 1))
        self.gradient.view(-1).index_add_(0, children, (x * x + y * y).sqrt_().masked_fill_(~visible, 0.0))
        self.drawn.view(-1).index_add_(0, children, visible.long())
        shown = torch.zeros(opacities.shape, dtype=torch.bool)
        shown.view(-1)[children] = visible
        # An anchor without a drawn child counts as visited too: pruning needs its opacity.
        visited = shown.any(dim=-1) | (opacities.amax(dim=-1) <= constants.ALPHA_MIN)
        self.visits += visited
        self.opacity += opacities.clamp_min(0).sum(-1).double() * visited

    def resize(self, keep: Bool[Tensor, " anchor"] | None = None, append: int = 0) -> None:
        """Follow the scaffold: remove rows outside `keep`, then append `append` empty ones."""
        for name in self.NAMES:
            rows: Tensor = getattr(self, name)
            if keep is not None:
                rows = rows[keep]
            setattr(self, name, torch.cat([rows, rows.new_zeros((append, *rows.shape[1:]))]))

    def reset_grown(self, min_observations: int) -> None:
        """Reset children that were observed often enough for the growth that has just been decided."""
        decided = self.drawn > min_observations
        self.gradient[decided] = 0
        self.drawn[decided] = 0

    def reset_pruned(self, visits: int) -> None:
        """Reset anchors visited more than `visits` times: old opacities say nothing about the present one."""
        decided = self.visits > visits
        self.opacity[decided] = 0
        self.visits[decided] = 0

    def state(self) -> dict[str, Tensor]:
        """Sums and counts by name."""
        return {name: getattr(self, name) for name in self.NAMES}

    def load(self, state: dict[str, Tensor]) -> None:
        """Continue from what `state()` returned."""
        for name in self.NAMES:
            setattr(self, name, state[name].clone())
