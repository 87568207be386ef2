"""Splats: static Gaussians whose colour is a sum of spherical harmonics, as the common tools exchange them.

Basis, order and signs are those of 3D Gaussian Splatting: RGB = 1/2 + sum_k h_k Y_k(v), with the unit vector v from the
camera centre to the centre of the Gaussian.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final

import torch
from jaxtyping import Float
from numpy.typing import ArrayLike
from torch import Tensor

from graings.camera.sampling_rate import SamplingRate
from graings.gaussians import Gaussians
from graings.scene.encoding import direction_encoding, directions_from
from graings.scene.scene import Composed

MAX_DEGREE: Final = 3

_ORDER: Final = [1, 2, 0, *range(3, 15)]  # of our harmonics (x, y, z, then as in 3DGS) in that of 3DGS: y, z, x
_SIGNS: Final = [(-1.0) ** m for degree in range(1, MAX_DEGREE + 1) for m in range(-degree, degree + 1)]


@dataclass(frozen=True, slots=True, eq=False)
class Splats:
    """N static Gaussians in normalised units, rows as in `Gaussians`.

    `harmonics` are the coefficients h_k of RGB, degree 0 first: 1, 4, 9 or 16 of them, else `ValueError` is raised.
    `blur` is the variance of the low-pass filter in px^2 at the sampling rate `sampling`; None: in every image, which
    is the rule of 3DGS.
    """

    means: Float[Tensor, "gaussian 3"]
    quats: Float[Tensor, "gaussian 4"]
    log_scales: Float[Tensor, "gaussian 3"]
    opacities: Float[Tensor, " gaussian"]
    harmonics: Float[Tensor, "gaussian harmonic 3"]
    blur: float
    sampling: SamplingRate | None

    def __post_init__(self) -> None:
        if self.harmonics.ndim != 3 or self.harmonics.shape[1] not in {(d + 1) ** 2 for d in range(MAX_DEGREE + 1)}:
            raise ValueError(f"harmonics must have shape (N, 1, 4, 9 or 16, 3), got {tuple(self.harmonics.shape)}")

    @property
    def degree(self) -> int:
        """Highest degree of the harmonics, 0 to 3."""
        return math.isqrt(self.harmonics.shape[1]) - 1

    def __len__(self) -> int:
        return len(self.means)

    def rows(self, kept: Tensor) -> Splats:
        """Those at the indices, or where the mask is true."""
        names = ("means", "quats", "log_scales", "opacities", "harmonics")
        return replace(self, **{name: getattr(self, name)[kept] for name in names})

    def compose(self, eye: ArrayLike, time: float) -> Composed:
        """The Gaussians seen from the camera centre `eye` [3]; the same at every `time`."""
        basis = harmonic_basis(directions_from(eye, self.means), self.degree)
        colors = torch.einsum("nk,nkc->nc", basis, self.harmonics) + 0.5
        rows = torch.arange(len(self))
        return Composed(
            gaussians=Gaussians(
                self.means, self.quats, self.log_scales, self.opacities, colors.clamp_min(0.0), uids=rows
            ),
            children=rows,
            blur=self.blur,
            sampling=self.sampling,
        )


def harmonic_basis(directions: Float[Tensor, "*batch 3"], degree: int) -> Float[Tensor, "*batch harmonic"]:
    """Y_k of unit `directions` for degrees 0 to `degree`, in the order and with the signs of 3DGS."""
    constant = directions.new_full((*directions.shape[:-1], 1), math.sqrt(1 / (4 * math.pi)))
    if degree == 0:
        return constant
    count = degree * (degree + 2)
    ours = direction_encoding(directions, degree)[..., _ORDER[:count]]  # of mean square 1/3; theirs: 1 / (4 pi)
    return torch.cat([constant, ours * (math.sqrt(3 / (4 * math.pi)) * ours.new_tensor(_SIGNS[:count]))], dim=-1)
