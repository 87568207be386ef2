"""MotionTracks: points on content with large motion, and where they are at the training times.

A model that has missed such content finds it with them: its first anchors get these points, and DeformNet is drawn
towards their displacements (`track_loss`) until it has learned from the images to follow.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from graings.training.tracks.frame_residual import FrameResidual
from graings.training.tracks.residual_hulls import Points, residual_hulls

# Points that are followed, points of a hull that they are fitted to, and points at rest.
TRACKED, FITTED, RESTING = 400, 600, 200

# Content moves far if it goes farther than its own size: twice the root mean squared radius of its points.
MIN_TRAVEL: Final = 1.0

# A component follows the hulls if its points are on average within this part of its radius of them, and they of the
# points. Of the tested clips, those that gained have 0.16 to 0.3, those that lost (limbs, spokes) 0.31 to 1.1.
MAX_MISFIT: Final = 0.3

# If a smaller share of what goes far follows the hulls, the rest is not to be trusted either.
MIN_FOLLOWING: Final = 0.5

# Two points belong together if they are nearer than so many median distances to the nearest point.
REACH: Final = 3.0
ITERATIONS: Final = 15


@dataclass(frozen=True, slots=True, eq=False)
class MotionTracks:
    """`positions` of `points` at `times` (ascending), and points at `rest`, all in normalised units, float32."""

    points: Float[Tensor, "point 3"]
    times: Float[Tensor, " time"]
    positions: Float[Tensor, "time point 3"]
    rest: Float[Tensor, "resting 3"]

    def displacements(self, moments: Sequence[float]) -> Float[Tensor, "moment point 3"]:
        """From `points` to their positions at `moments`, linear between the times and beyond them."""
        wanted = torch.tensor(moments, dtype=self.times.dtype)
        after = torch.searchsorted(self.times, wanted).clamp(1, len(self.times) - 1)
        before = after - 1
        share = (wanted - self.times[before]) / (self.times[after] - self.times[before])
        between = torch.lerp(self.positions[before], self.positions[after], share[:, None, None])
        return between - self.points

    def tensors(self) -> dict[str, Tensor]:
        """For a checkpoint."""
        return {"points": self.points, "times": self.times, "positions": self.positions, "rest": self.rest}

    @classmethod
    def of_tensors(cls, tensors: Mapping[str, Tensor]) -> MotionTracks | None:
        """The inverse of `tensors`; None for no tensors."""
        return cls(**tensors) if tensors else None


def find_tracks(
    residuals: Sequence[FrameResidual], half: float, anchors: Float[Tensor, "anchor 3"], generator: torch.Generator
) -> MotionTracks | None:
    """Tracks of the content that the residuals of a model show and that moves far; None where there is none.

    `half` is the half-size of the content, `anchors` those of the model: rest points are taken from them.
    """
    found = residual_hulls(residuals, half, generator)
    if found is None or len(found) < 2:
        return None
    times = np.array([time for time, _ in found])
    hulls = [subsampled(hull, FITTED, generator) for _, hull in found]
    usable = [index for index, hull in enumerate(hulls) if len(hull)]
    reference = min(usable, key=lambda index: abs(times[index] - 0.5))
    points = subsampled(hulls[reference], TRACKED, generator)
    components = _components(points)
    positions = _follow(points, components, hulls, reference)
    far = _followed_far(positions, components, hulls)
    if not far.any():
        return None
    moving = torch.from_numpy(points[far])
    distance = torch.cdist(anchors.detach().double(), moving).amin(1)
    resting = anchors.detach()[distance > REACH * _spacing(points)]
    order = torch.randperm(len(resting), generator=generator)[:RESTING]
    return MotionTracks(
        moving.float(), torch.from_numpy(times).float(), torch.from_numpy(positions[:, far]).float(), resting[order]
    )


def subsampled(points: Points, most: int, generator: torch.Generator) -> Points:
    """At most `most` of points [M, 3], a random sample."""
    return points[torch.randperm(len(points), generator=generator)[:most].numpy()]


def _spacing(points: Points) -> float:
    distances = torch.cdist(torch.from_numpy(points), torch.from_numpy(points)).fill_diagonal_(torch.inf)
    return float(distances.amin(1).median())


def _components(points: Points) -> NDArray[np.int64]:
    """A number per point [M], the same for points that hang together."""
    near = torch.cdist(torch.from_numpy(points), torch.from_numpy(points)) < REACH * _spacing(points)
    labels = torch.arange(len(points))
    while not torch.equal(labels, smaller := torch.where(near, labels, len(points)).amin(1)):
        labels = smaller
    return np.unique(labels.numpy(), return_inverse=True)[1]


def _follow(points: Points, components: NDArray[np.int64], hulls: Sequence[Points], reference: int) -> Points:
    """Positions [T, M, 3] of points of the hull at `reference`, each component moved rigidly from hull to hull."""
    positions = np.empty((len(hulls), *points.shape))
    positions[reference] = points
    for step, end in ((1, len(hulls)), (-1, -1)):
        here = points
        steps = np.tile(np.eye(4), (components.max() + 1, 1, 1))  # the last motion of each component, kept up
        for time in range(reference + step, end, step):
            moved = _moved(here, components, steps)
            if len(hulls[time]):
                moved = _fitted(moved, components, hulls[time])
            steps = np.stack([_rigid(here[one], moved[one]) for one in _members(components)])
            positions[time] = here = moved
    return positions


def _fitted(points: Points, components: NDArray[np.int64], hull: Points) -> Points:
    """`points` after rigid motions of their components onto a hull: points to the nearest of it, and it to them."""
    target = torch.from_numpy(hull)
    for _ in range(ITERATIONS):
        distances = torch.cdist(torch.from_numpy(points), target)
        to, back = distances.argmin(1).numpy(), distances.argmin(0).numpy()
        motions = []
        for one in _members(components):
            mine = one[back]
            motions.append(
                _rigid(np.concatenate([points[one], points[back[mine]]]), np.concatenate([hull[to[one]], hull[mine]]))
            )
        points = _moved(points, components, np.stack(motions))
    return points


def _members(components: NDArray[np.int64]) -> list[NDArray[np.bool_]]:
    return [components == one for one in range(components.max() + 1)]


def _rigid(start: Points, end: Points) -> Points:
    """The rigid motion [4, 4] that takes `start` [M, 3] nearest to `end`, least squares (Kabsch)."""
    a, b = start.mean(0), end.mean(0)
    left, _, right = np.linalg.svd((start - a).T @ (end - b))
    flip = np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right)) or 1.0])
    motion = np.eye(4)
    motion[:3, :3] = (left @ flip @ right).T
    motion[:3, 3] = b - motion[:3, :3] @ a
    return motion


def _moved(points: Points, components: NDArray[np.int64], motions: Points) -> Points:
    moves = motions[components]
    return np.einsum("mij,mj->mi", moves[:, :3, :3], points) + moves[:, :3, 3]


def _followed_far(positions: Points, components: NDArray[np.int64], hulls: Sequence[Points]) -> NDArray[np.bool_]:
    """Points [M] of components that go farther than their size and stay on the hulls; none where most do not stay."""
    apart = [
        torch.cdist(torch.from_numpy(at), torch.from_numpy(hull))
        for at, hull in zip(positions, hulls, strict=True)
        if len(hull)
    ]
    to_hull = torch.stack([distances.amin(1) for distances in apart]).mean(0).numpy()
    from_hull = float(np.mean([float(distances.amin(0).mean()) for distances in apart]))
    far, followed = np.zeros((2, len(components)), np.bool_)
    for one in _members(components):
        centers = positions[:, one].mean(1)
        radius = float(np.sqrt(((positions[0, one] - centers[0]) ** 2).sum(-1).mean()))
        travel = float(torch.cdist(torch.from_numpy(centers), torch.from_numpy(centers)).max())
        far |= one & (travel > 2 * radius * MIN_TRAVEL)
        followed |= one & (max(to_hull[one].mean(), from_hull) < MAX_MISFIT * radius)
    kept = far & followed
    return kept & (kept.sum() >= MIN_FOLLOWING * far.sum())
