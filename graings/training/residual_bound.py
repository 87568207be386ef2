"""Residual bound: by how much the appearance residual changes the training views.

Leaving it out changes Gaussian i by dc_i in colour and by the share eta_i = |d alpha_i| / alpha_i in opacity. To
first order a pixel changes by at most sum_i w_i (|dc_i| + eta_i), w_i being the weight of i in the pixel, because
colours lie in [0, 1] (numerics notes, 5.3). The same kernel draws this sum, with |dc_i| + eta_i as colours. It has no
terms of second order, and no Gaussians that appear or vanish, so the bound is not less than the measured difference of
the two pictures.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Final

import torch
from torch import Tensor

from graings.capture.capture import Frame
from graings.constants import ALPHA_MIN
from graings.render import render_composition
from graings.scene.scene import Composition, Scene

BLACK: Final = (0.0, 0.0, 0.0)


@torch.inference_mode()
def residual_bound(scene: Scene, frames: Iterable[Frame], background: Sequence[float], limit: float) -> float:
    """Greatest change of a channel of a pixel of `frames` (values in [0, 1]) where the residual is left out.

    Ends at the first view above `limit`, whose bound is returned. 0 for a scene without a residual.
    """
    greatest = 0.0
    residual, temporal = scene.residual, scene.temporal
    scene.temporal = True
    try:
        for frame in frames:
            scene.residual = residual
            composition = scene.compose(frame.camera.center, frame.time)
            if composition.residual is None:
                return 0.0
            with_residual = render_composition(composition, frame.camera, background)
            channel = render_composition(_error_channel(composition), frame.camera, BLACK)
            scene.residual = None
            without = render_composition(scene.compose(frame.camera.center, frame.time), frame.camera, background)
            difference = (with_residual.color - without.color).abs().amax()
            greatest = max(greatest, float(channel.color.amax()), float(difference))
            if greatest > limit:
                break
    finally:
        scene.residual, scene.temporal = residual, temporal
    return greatest


def _error_channel(composition: Composition) -> Composition:
    """The composition with |dc| + eta in place of the colours."""
    residual = composition.residual
    assert residual is not None
    gaussians = composition.gaussians
    opacities, change = gaussians.opacities, residual[:, 3]
    eta = change.abs() / opacities.clamp_min(ALPHA_MIN)
    vanishes = opacities - change <= ALPHA_MIN
    eta = torch.where(vanishes, torch.ones_like(eta), eta)
    colors: Tensor = residual[:, :3].abs() + eta.unsqueeze(-1)
    return replace(composition, gaussians=replace(gaussians, colors=colors))
