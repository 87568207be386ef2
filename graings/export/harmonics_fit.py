"""fit_splats: a trained scene at one time as static Gaussians with spherical harmonics.

The scene's colours come from networks of the viewing direction. For each Gaussian the harmonics are fitted to its
colours in the training views by least squares. A view counts as much as the Gaussian contributes to its picture, which
is the sum of its blending weights over all pixels. So the colour of a surface is fitted where the surface is seen.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from graings.camera.camera import Camera
from graings.render import contributions
from graings.scene.prepared import PreparedScene
from graings.scene.splats import MAX_DEGREE, Splats, harmonic_basis

MAX_VIEWS: Final = 100  # evenly chosen if there are more: 16 coefficients need no more directions
RIDGE: Final = 1e-4  # weight of squared coefficients of degree l, times l (l + 1), beside a mean square of colours
_FLOOR: Final = 1e-3  # px added to each contribution: a Gaussian that no view shows is fitted to all of them
_NEGLIGIBLE: Final = 0.5 / 255  # root mean square of colours that a higher degree must gain to be worth its bytes
_CHUNK: Final = 4096


@dataclass(frozen=True, slots=True, eq=False)
class HarmonicsFit:
    """Splats in normalised units and how they were found."""

    splats: Splats
    children: Int64[Tensor, " gaussian"]  # of each its flat slot (anchor * k + child) of the scene, ascending
    contributions: Float[Tensor, " gaussian"]  # px: the largest contribution to the picture of one of the views
    errors: tuple[float, ...]  # root mean square error of the colours in the views for degrees 0, 1, ...


def fit_splats(
    scene: PreparedScene | Splats, cameras: Sequence[Camera], time: float, *, degree: int | None = None
) -> HarmonicsFit:
    """`scene` at `time` in [0, 1] as seen by `cameras`, with harmonics up to `degree`.

    None: the lowest degree whose error of the colours is at most half an 8-bit level above that of degree 3. Opacities
    that depend on the view become their mean. Raises `ValueError` for a degree out of range or without cameras.
    """
    if degree is not None and not 0 <= degree <= MAX_DEGREE:
        raise ValueError(f"the degree of the harmonics must lie in [0, {MAX_DEGREE}], got {degree}")
    if not cameras:
        raise ValueError("harmonics are fitted to views: at least one camera is needed")
    chosen = [cameras[i] for i in spread(len(cameras), MAX_VIEWS)]
    views = [scene.compose(camera.center, time) for camera in chosen]
    children = torch.unique(torch.cat([view.children for view in views]))
    opacities = torch.zeros(len(children))
    means, quats, log_scales = (torch.zeros(len(children), width) for width in (3, 4, 3))
    colors, weights = torch.zeros(len(views), len(children), 3), torch.zeros(len(views), len(children))
    for index, (view, camera) in enumerate(zip(views, chosen, strict=True)):
        found, rows = view.gaussians, torch.searchsorted(children, view.children)
        colors[index, rows], weights[index, rows] = found.colors, contributions(view, camera)
        opacities[rows] += found.opacities / len(views)
        means[rows], quats[rows], log_scales[rows] = found.means, found.quats, found.log_scales
    eyes = torch.tensor([camera.center.tolist() for camera in chosen], dtype=torch.float64)
    highest = MAX_DEGREE if degree is None else degree
    fits, errors = _least_squares(means.double(), eyes, colors, weights + _FLOOR, highest)
    if degree is None:
        degree = next(d for d in range(highest + 1) if errors[d] <= errors[highest] + _NEGLIGIBLE)
    splats = Splats(means, quats, log_scales, opacities, fits[degree].float(), views[0].blur, views[0].sampling)
    return HarmonicsFit(splats, children, weights.amax(0), tuple(errors[: highest + 1]))


def spread(count: int, most: int) -> list[int]:
    """At most `most` of `count` indices, at even distances."""
    kept = min(count, most)
    return [index * count // kept for index in range(kept)]


def _least_squares(
    means: Float[Tensor, "gaussian 3"],
    eyes: Float[Tensor, "view 3"],
    colors: Float[Tensor, "view gaussian 3"],
    weights: Float[Tensor, "view gaussian"],
    highest: int,
) -> tuple[list[Tensor], list[float]]:
    """Coefficients [gaussian, harmonic, 3] for each degree up to `highest`, and the errors of the colours ."""
    sizes = [(degree + 1) ** 2 for degree in range(highest + 1)]
    penalty = torch.cat(
        [torch.full((2 * d + 1,), RIDGE * d * (d + 1), dtype=torch.float64) for d in range(highest + 1)]
    )
    fits: list[list[Tensor]] = [[] for _ in sizes]
    squares = torch.zeros(len(sizes), dtype=torch.float64)
    for start in range(0, len(means), _CHUNK):
        part = slice(start, start + _CHUNK)
        directions = torch.nn.functional.normalize(means[part, None] - eyes, dim=-1)
        basis = harmonic_basis(directions, highest)
        wanted = colors[:, part].transpose(0, 1).double() - 0.5
        weight = weights[:, part].transpose(0, 1).double().unsqueeze(-1)
        weighted = (weight * basis).transpose(1, 2)
        matrix, right = weighted @ basis, weighted @ wanted
        matrix.diagonal(dim1=1, dim2=2).add_(weight.sum(1) * penalty)
        for place, size in enumerate(sizes):
            found = torch.linalg.solve(matrix[:, :size, :size], right[:, :size])
            squares[place] += (weight * (basis[..., :size] @ found - wanted).square()).sum()
            fits[place].append(found)
    mean_squares = squares / (3 * weights.sum(dtype=torch.float64))
    return [torch.cat(parts) for parts in fits], mean_squares.sqrt().tolist()


def fit_colors(
    means: Float[Tensor, "gaussian 3"],
    eyes: Float[Tensor, "view 3"],
    colors: Float[Tensor, "view gaussian 3"],
    weights: Float[Tensor, "view gaussian"],
) -> tuple[Float[Tensor, "gaussian harmonic 3"], float]:
    """Harmonics of `colors` seen from `eyes`, of the lowest degree that suffices, and their root mean square error.

    `weights` are contributions in px: how much each colour counts.
    """
    fits, errors = _least_squares(means.double(), eyes.double(), colors, weights + _FLOOR, MAX_DEGREE)
    degree = next(d for d in range(MAX_DEGREE + 1) if errors[d] <= errors[MAX_DEGREE] + _NEGLIGIBLE)
    return fits[degree].float(), errors[degree]
