"""DensityControl: the schedule of observing, growing and pruning anchors.

`growth` decides which anchors; this module applies the decisions to scene, optimiser and statistics.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from graings.capture.capture import Frame
from graings.capture.mask import Mask
from graings.config import TrainConfig
from graings.raster.result import RenderResult
from graings.report.events import Event, Grew, GrowthCapped, Pruned, Thinned
from graings.scene.scene import Composition, Scene
from graings.training.density import growth
from graings.training.density.budget import most_anchors
from graings.training.density.statistics import DensityStatistics
from graings.training.guard.collapse import mean_logits
from graings.training.optimizer import Optimizer

# Above this share of the budget, growth first prunes faint anchors.
NEAR_BUDGET = 0.9

# Where the initial anchors exceed the budget and nine tenths of them were visited often enough to be pruned, the rest
# is thinned to this share of the budget: otherwise no anchor could be added for the rest of the run.
MIN_OBSERVED_FRACTION = 0.9
THINNED_FRACTION = 0.5


class DensityControl:
    """Grows and prunes one scene. `voxel_size` is that of the finest cells, normalised."""

    def __init__(self, config: TrainConfig, scene: Scene, voxel_size: float) -> None:
        self.most = most_anchors(config)
        self.config = config.density.model_copy(update={"max_anchors": self.most})
        self.makes_room = config.density.max_anchors is not None
        self.scaled = config.scaled
        self.voxel_size = voxel_size
        self.next_uid = scene.scaffold.count
        self.statistics = DensityStatistics(scene.scaffold.count, scene.scaffold.slots)

    def watches(self, iteration: int) -> bool:
        """Whether `iteration` is observed for the next growth or pruning."""
        last_growth = self.scaled(self.config.grow_until)
        growing = self.scaled(self.config.statistics_from) < iteration <= last_growth
        return growing or last_growth < iteration <= self.scaled(self.config.prune_until)

    def observe(
        self,
        frames: Sequence[Frame],
        compositions: Sequence[Composition],
        results: Sequence[RenderResult],
        offsets: Sequence[Tensor],
        masks: Sequence[Mask | None] | None = None,
    ) -> None:
        """Record the views of one step; `offsets` hold dL/d(projected centre), L being the mean over views.

        `masks` are the valid pixels of each view: a Gaussian whose centre is elsewhere was not observed.
        """
        masks = masks or [None] * len(frames)
        for frame, composition, result, offset, valid in zip(
            frames, compositions, results, offsets, masks, strict=True
        ):
            if offset.grad is not None:
                visible = result.radii.amax(-1) > 0
                if valid is not None:
                    visible[visible.clone()] = _at(torch.from_numpy(valid), result.means2d[visible])
                self.statistics.observe(
                    composition.children,
                    offset.grad * len(frames),  # of the view's own loss, not of the mean
                    visible,
                    composition.opacities,
                    (frame.camera.width, frame.camera.height),
                )

    def grows(self, iteration: int) -> bool:
        """Whether anchors may be added after `iteration`."""
        first, last = self.scaled(self.config.grow_from), self.scaled(self.config.grow_until)
        return first <= iteration <= last and iteration % self.config.grow_every == 0

    def prunes(self, iteration: int) -> bool:
        """Whether faint anchors are removed after `iteration`."""
        first, last = self.scaled(self.config.prune_from), self.scaled(self.config.prune_until)
        return first <= iteration <= last and iteration % max(1, self.scaled(self.config.prune_every)) == 0

    def grow(
        self, iteration: int, scene: Scene, optimizer: Optimizer, generator: torch.Generator
    ) -> tuple[int, list[Event]]:
        """Add anchors where the gradients of the projected centres are large; returns how many, and what happened.

        `iteration` is that of the run, for the events.
        """
        events: list[Event] = []
        # Faint anchors would use up the budget for good: what is not drawn gets no gradient and does not recover.
        if self.makes_room and scene.scaffold.count > NEAR_BUDGET * self.most:
            visited = float((self.statistics.visits > self.config.prune_min_views).double().mean())
            events = self.prune(iteration, scene, optimizer)
            if visited > MIN_OBSERVED_FRACTION and scene.scaffold.count > self.most:
                events += self._thin(iteration, scene, optimizer, generator)
        grown = growth.grow(
            scene.scaffold,
            self.statistics,
            mean_logits(scene),
            self.config,
            self.voxel_size,
            self.next_uid,
            generator,
        )
        self.statistics.reset_grown(self.config.min_observations)
        if grown.capped:
            anchors = scene.scaffold.count + len(grown)
            events.append(GrowthCapped(iteration=iteration, anchors=anchors, max_anchors=self.most))
        if len(grown) > 0:
            optimizer.append(grown.rows)
            self.statistics.resize(append=len(grown))
            self.next_uid += len(grown)
            events.insert(0, Grew(iteration=iteration, anchors=len(grown)))
        return len(grown), events

    def prune(self, iteration: int, scene: Scene, optimizer: Optimizer) -> list[Event]:
        """Remove anchors that show nothing; returns what happened. `iteration` is that of the run."""
        keep = growth.prune(scene.scaffold, self.statistics, self.config)
        self.statistics.reset_pruned(self.config.prune_min_views)
        removed = int((~keep).sum())
        if removed == 0:
            return []
        optimizer.keep(keep)
        self.statistics.resize(keep=keep)
        return [Pruned(iteration=iteration, anchors=removed)]

    def _thin(self, iteration: int, scene: Scene, optimizer: Optimizer, generator: torch.Generator) -> list[Event]:
        """Make room for growth where the initial anchors are more than the budget; returns what happened."""
        count, most = scene.scaffold.count, max(2, int(THINNED_FRACTION * self.most))
        keep, wider = growth.thin_out(scene.scaffold, self.statistics, most, generator)
        with torch.no_grad():
            scene.scaffold.log_scales.add_(wider.unsqueeze(-1))
        optimizer.keep(keep)
        self.statistics.resize(keep=keep)
        return [Thinned(iteration=iteration, anchors_before=count, anchors_after=most)]

    def state(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """Statistics, and facts as JSON."""
        return self.statistics.state(), {"next_uid": self.next_uid, "voxel_size": self.voxel_size}

    def load(self, statistics: dict[str, Tensor], facts: dict[str, Any]) -> None:
        """Continue from what `state()` gave."""
        self.statistics.load(statistics)
        self.next_uid = int(facts["next_uid"])
        self.voxel_size = float(facts["voxel_size"])


def _at(valid: Tensor, centers: Tensor) -> Tensor:
    """Values of `valid` [H, W] at projected centres [n, 2] in px, of the nearest pixel outside the image."""
    height, width = valid.shape
    columns, rows = centers[:, 0].clamp(0, width - 1).long(), centers[:, 1].clamp(0, height - 1).long()
    return valid[rows, columns]
