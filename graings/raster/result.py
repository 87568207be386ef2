"""RenderResult and RasterSettings: the output of a rasterizer, and the constants of the call."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from torch import Tensor

from graings import constants


@dataclass(frozen=True, slots=True)
class RasterSettings:
    """Constants of one call; the defaults define the image (`graings.constants`).

    `alpha_min = transmittance_min = 0` is the untruncated sum of Eq. (2), except for transmittances below 1e-30
    (1e-290 in double), which do not change any sum. `compat` is for comparison with public rasterizers only: exclusive
    stop (the Gaussian that would cross the threshold is not blended) and a square footprint of three standard
    deviations.

    Raises `ValueError` for values out of range; `alpha_max` is below 1, also in float32, because the backward pass
    divides by 1 - alpha.
    """

    alpha_min: float = constants.ALPHA_MIN
    transmittance_min: float = constants.TRANSMITTANCE_MIN
    alpha_max: float = constants.ALPHA_MAX
    blur: float = constants.BLUR
    near: float = constants.NEAR
    far: float = constants.FAR
    frustum_margin: float = constants.FRUSTUM_MARGIN
    compat: bool = False

    def __post_init__(self) -> None:
        if not 0 <= self.alpha_min < self.alpha_max or not np.float32(self.alpha_max) < 1:
            raise ValueError(f"0 <= alpha_min < alpha_max < 1 expected, got {self.alpha_min} and {self.alpha_max}")
        if not 0 <= self.transmittance_min < 1:
            raise ValueError(f"transmittance_min must lie in [0, 1), got {self.transmittance_min}")
        if not 0 <= self.near < self.far:
            raise ValueError(f"0 <= near < far expected, got {self.near} and {self.far}")
        if not (self.blur >= 0 and self.frustum_margin >= -1):
            raise ValueError(f"blur >= 0 and frustum_margin >= -1 expected, got {self.blur} and {self.frustum_margin}")


DEFAULT_SETTINGS = RasterSettings()


@dataclass(frozen=True, slots=True, eq=False)
class RenderResult:
    """One rendered view; images are [height, width, ...] in the dtype of the Gaussians.

    `depth` is the blended sum of w_i Z_i (normalised units, 0 where nothing is drawn; divide by `alpha` for
    the expected depth), or None if it was not requested. `means2d` (pixels) and `radii` (half-widths of the footprint
    in pixels, 0 = not drawn) carry no gradient.
    """

    color: Float[Tensor, "height width 3"]
    alpha: Float[Tensor, "height width"]
    depth: Float[Tensor, "height width"] | None
    means2d: Float[Tensor, "gaussian 2"]
    radii: Float[Tensor, "gaussian 2"]
    culled: dict[str, int]  # why Gaussians were not drawn: non_finite, zero_quat, behind, faint, outside
