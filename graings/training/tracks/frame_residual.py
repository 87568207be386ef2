"""FrameResidual: where the render of a training view differs from its image by more than training leaves over."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn import functional

from graings.capture.capture import Frame
from graings.capture.images import ImageStore
from graings.render import render
from graings.scene.prepared import PreparedScene
from graings.training.curriculum.missing_object import has_missing_object
from graings.training.initialization.visual_hull import dilated

# Residuals are averaged over cells of which so many fit the longer image side, and then over SMOOTH x SMOOTH cells.
SIDE: Final = 128
SMOOTH: Final = 5

# Mean absolute difference of colour above which a cell differs. A model part of the way through its training leaves
# 0.01 in the median of a textured room, an object that it does not show 0.1 to 0.3.
DIFFERENCE: Final = 0.15


@dataclass(frozen=True, slots=True, eq=False)
class FrameResidual:
    """`differs` [h, w] are cells of `cell` x `cell` px that differ; `seen` [h, w] those without a masked pixel.

    `missing` says whether a whole object is missing (`missing_object`).
    """

    frame: Frame
    missing: bool
    differs: NDArray[np.bool_]
    seen: NDArray[np.bool_]
    cell: int

    @classmethod
    def of(cls, scene: PreparedScene, frame: Frame, images: ImageStore, background: Sequence[float]) -> FrameResidual:
        """That of `scene` at the camera and time of `frame`."""
        drawn = render(scene, frame.camera, frame.time, background).color
        image, valid = torch.from_numpy(images.rgb(frame)), images.valid(frame)
        known = torch.ones(image.shape[:2], dtype=torch.bool) if valid is None else torch.from_numpy(valid)
        difference = torch.where(known.unsqueeze(-1), drawn - image, 0.0)
        cell = max(1, max(known.shape) // SIDE)
        mean = _cells(difference.abs().mean(-1), cell)
        smooth = functional.avg_pool2d(mean, SMOOTH, 1, SMOOTH // 2, count_include_pad=False)
        differs = dilated(smooth[0, 0].numpy() > DIFFERENCE, 1)
        seen = _cells(known.float(), cell)[0, 0].numpy() > 1 - 1e-6
        return cls(frame, has_missing_object(difference), differs, seen, cell)


def _cells(values: torch.Tensor, cell: int) -> torch.Tensor:
    """Means [1, 1, h, w] of cells of `values` [H, W]; those at the right and lower border may be smaller."""
    return functional.avg_pool2d(values[None, None], cell, ceil_mode=True, count_include_pad=False)
