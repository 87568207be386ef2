"""View dependence: what a trained scene loses where the colours of another viewpoint are shown.

A matte scene loses nothing. The measure says how much the model uses the viewing direction, not how good it would be
without: that is for another training to show.
"""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from typing import Final

import torch

from graings.capture.capture import Frame
from graings.capture.images import ImageStore
from graings.render import render_composition
from graings.scene.scene import Scene

OTHER_VIEWS: Final = 2


@torch.inference_mode()
def view_dependence(
    scene: Scene, frames: Sequence[Frame], others: Sequence[Frame], images: ImageStore, background: Sequence[float]
) -> float | None:
    """Mean loss of PSNR of `frames`, in dB, with the colours and opacities that cameras of `others` would see.

    Two other cameras for each frame, a third of `others` apart. None without frames or others.
    """
    if not frames or not others:
        return None
    losses = []
    for index, frame in enumerate(frames):
        target, valid = torch.from_numpy(images.rgb(frame)), images.valid(frame)
        kept = torch.ones(target.shape[:2], dtype=torch.bool) if valid is None else torch.from_numpy(valid)
        if not kept.any():
            continue
        third = len(others) // (OTHER_VIEWS + 1)
        eyes = [others[(index + turn * third) % len(others)].camera.center for turn in range(1, OTHER_VIEWS + 1)]
        own, *rest = (
            _psnr(
                render_composition(scene.compose(eye, frame.time), frame.camera, background).color[kept], target[kept]
            )
            for eye in (frame.camera.center, *eyes)
        )
        losses.append(own - statistics.mean(rest))
    return statistics.mean(losses) if losses else None


def _psnr(image: torch.Tensor, target: torch.Tensor) -> float:
    return float(-10.0 * (image.clamp(0, 1) - target).square().mean().clamp_min(1e-10).log10())
