"""The objective of one step (Eq. 14) for its views, with the terms that are ours: squared error, alpha and tracks."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from graings.capture.capture import Frame
from graings.capture.images import ImageStore
from graings.config import TrainConfig
from graings.random import RandomStreams
from graings.raster.photometric import photometric
from graings.raster.result import RenderResult
from graings.scene.scene import Composition, Scene
from graings.training import losses
from graings.training.regularisers import regularisers
from graings.training.tracks.motion_tracks import MotionTracks
from graings.training.tracks.track_loss import UNTIL, track_loss


@dataclass(frozen=True, slots=True, eq=False)
class StepLoss:
    """The loss of one step. `without_squared` is comparable between steps before and after the squared term starts."""

    total: Float[Tensor, ""]
    without_squared: Float[Tensor, ""]
    photometric: Float[Tensor, " view"]
    mse: tuple[float, ...]  # of each view


class Objective:
    """Computes the loss of steps on one capture. `times` are its distinct training times, ascending."""

    def __init__(
        self,
        config: TrainConfig,
        images: ImageStore,
        times: NDArray[np.float64],
        streams: RandomStreams,
        tracks: MotionTracks | None = None,
    ) -> None:
        self.config = config
        self.images = images
        self.times = times
        self.streams = streams
        self.tracks = tracks

    def __call__(
        self,
        scene: Scene,
        frames: Sequence[Frame],
        compositions: Sequence[Composition],
        results: Sequence[RenderResult],
        iteration: int,
    ) -> StepLoss:
        """The loss of the views `frames`, composed together and drawn as `results`."""
        targets = [torch.from_numpy(self.images.rgb(frame)) for frame in frames]
        masks = [self._valid(frame) for frame in frames]
        squared = self._squared_weight(iteration)
        differences = torch.stack(
            [
                photometric(result.color, target, self.config.loss.ssim, squared, valid=valid)
                for result, target, valid in zip(results, targets, masks, strict=True)
            ]
        )
        moments = [frame.time for frame in frames]
        total = self.regularisers(scene, compositions, moments) + differences.mean()
        total = total + self._alpha_term(frames, results) + self._track_term(scene, moments, iteration)
        mse = tuple(_mse(r.color.detach(), t, v) for r, t, v in zip(results, targets, masks, strict=True))
        without_squared = total.detach() - squared * statistics.mean(mse)
        return StepLoss(total, without_squared, differences, mse)

    def regularisers(self, scene: Scene, compositions: Sequence[Composition], moments: Sequence[float]) -> Tensor:
        """The terms on the model itself, weighted."""
        return regularisers(scene, compositions, moments, self.times, self.config.loss, self.streams)

    def _squared_weight(self, iteration: int) -> float:
        """Weight of the squared error: 0 while anchors grow, because growth would follow its large gradients."""
        config = self.config
        return config.loss.squared if iteration > config.scaled(config.density.grow_until) else 0.0

    def _track_term(self, scene: Scene, moments: Sequence[float], iteration: int) -> Tensor:
        """Difference of the deformation and the tracks, with a weight that falls linearly from 1 to 0."""
        weight = 1 - iteration / max(1, self.config.scaled(UNTIL))
        if self.tracks is None or weight <= 0:
            return torch.zeros(())
        return weight * track_loss(scene, self.tracks, moments)

    def _alpha_term(self, frames: Sequence[Frame], results: Sequence[RenderResult]) -> Tensor:
        """Difference of alpha over the views that have an alpha channel; a view without one contributes 0."""
        total, weight = torch.zeros(()), self.config.loss.alpha
        if weight == 0:
            return total
        for frame, result in zip(frames, results, strict=True):
            alpha = self.images.alpha(frame)
            if alpha is not None:
                total = total + losses.alpha(result.alpha, torch.from_numpy(alpha), self._valid(frame))
        return total * (weight / len(frames))

    def _valid(self, frame: Frame) -> Tensor | None:
        """The pixels [H, W] of `frame` that are not masked; None without a mask."""
        valid = self.images.valid(frame)
        return None if valid is None else torch.from_numpy(valid)


def _mse(image: Tensor, target: Tensor, valid: Tensor | None) -> float:
    """Mean squared difference over the `valid` pixels; 0 where there are none."""
    if valid is None:
        return float(functional.mse_loss(image, target))
    return float(functional.mse_loss(image[valid], target[valid], reduction="sum") / (3 * valid.sum()).clamp_min(1))
