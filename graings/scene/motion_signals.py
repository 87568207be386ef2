"""What a motion basis describes: geometry of children, measured in pixels, and their residual, in grey levels."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from numpy.typing import NDArray
from torch import Tensor

from graings import constants
from graings.camera.camera import Camera, View
from graings.scene.children import LOG_SCALE_RANGE, Geometry, quaternion_product
from graings.scene.prepared import PreparedScene
from graings.scene.time_basis import TimeSignal, pieces

# A Gaussian of opacity 1 is drawn up to this many standard deviations from its centre, where it falls to ALPHA_MIN.
REACH: Final = math.sqrt(-2.0 * math.log(constants.ALPHA_MIN))

# Training views that pixels are measured in, and eyes that the residual is averaged over: evenly chosen.
MOST_VIEWS: Final = 100
MOST_EYES: Final = 4
CHECKED_VIEWS: Final = 12  # that the average is compared with


def chosen(views: Sequence[View], most: int) -> list[View]:
    """`views` or `most` of them, evenly spaced."""
    return [views[len(views) * number // most] for number in range(most)] if len(views) > most else list(views)


class GeometrySignal(TimeSignal):
    """Offsets from the mean over time: mean (normalised units), rotation and log-scale.

    Rotations are offsets from the identity: the quaternion at a time is `quats` (x) (1 + offset). Errors are bounds in
    px of how far any point of the drawn ellipsoid is displaced, in the training view that shows the child largest:

        p_i (|dx| + REACH (2 |dq| s + |ds|)),    p_i = max over views of f |x - c| / Z^2

    with dq the difference of unit quaternions, s the largest standard deviation, ds its largest change. It is a bound
    because a rotation by theta moves a unit vector by at most 2 sin(theta / 2) <= 2 |dq|, and because f |x - c| / Z^2
    is the norm of the Jacobian of the projection.
    """

    def __init__(self, prepared: PreparedScene, views: Sequence[View], times: Sequence[float], bound: float) -> None:
        self._prepared = prepared
        everything = torch.arange(prepared.children)
        parts = [_State(prepared, rows, views, times) for rows in pieces(everything)] or [
            _State(prepared, everything, views, times[:1])
        ]
        self.means = torch.cat([part.means for part in parts])
        self.quats = torch.cat([part.quats for part in parts])
        self.log_scales = torch.cat([part.log_scales for part in parts])
        self.child_scales = torch.cat([part.rates for part in parts])
        self._inverse = _conjugate(self.quats) / self.quats.square().sum(-1, keepdim=True)
        self._sizes = self.log_scales.amax(-1).exp()
        motion = torch.zeros(prepared.children, dtype=self.means.dtype)
        nothing = self.means.new_zeros(1, 10)
        for rows in pieces(everything):
            for time in times:
                moved = self.errors(rows, nothing.expand(len(rows), 10), self.at(time, rows))
                motion[rows] = torch.maximum(motion[rows], moved)
        # `not <=`: a child that is not finite moves, so that the fit finds it.
        self.moving: Bool[Tensor, " child"] = ~(motion <= bound)
        self.rest_errors = motion[~self.moving]
        size = REACH * (float(self._sizes[self.moving].square().mean().sqrt()) if bool(self.moving.any()) else 1.0)
        self.value_scales = self.means.new_tensor([1.0] * 3 + [2 * size] * 4 + [size] * 3)

    def at(self, time: float, rows: Int64[Tensor, " row"]) -> Float[Tensor, "row 10"]:
        means, quats, log_scales = self._prepared.geometry(time, rows)
        rotations = quaternion_product(self._inverse[rows], quats)
        rotations[:, 0] -= 1
        return torch.cat([means - self.means[rows], rotations, log_scales - self.log_scales[rows]], dim=1)

    def errors(
        self, rows: Int64[Tensor, " row"], found: Float[Tensor, "row 10"], expected: Float[Tensor, "row 10"]
    ) -> Float[Tensor, " row"]:
        moved = (found[:, :3] - expected[:, :3]).norm(dim=-1)
        turned = (_unit(found[:, 3:7]) - _unit(expected[:, 3:7])).norm(dim=-1)
        here, there = (
            (self.log_scales[rows] + offsets[:, 7:]).clamp(*LOG_SCALE_RANGE).exp() for offsets in (found, expected)
        )
        bound: Tensor = moved + REACH * (2 * turned * there.amax(-1) + (here - there).abs().amax(-1))
        return bound * self.child_scales[rows]


class _State:
    """Mean state over time of some children, and their pixels per unit of length in the views."""

    def __init__(self, prepared: PreparedScene, rows: Tensor, views: Sequence[View], times: Sequence[float]) -> None:
        sampled: list[Geometry] = [prepared.geometry(time, rows) for time in times]
        means, quats, log_scales = (torch.stack(part) for part in zip(*sampled, strict=True))
        self.means, self.log_scales = means.mean(0), log_scales.mean(0)
        # The mean of quaternions that turn all the way around is near zero and no state to start from.
        average = quats.mean(0)
        usable = average.norm(dim=-1) > 0.5 * quats.norm(dim=-1).amax(0)
        self.quats = torch.where(usable.unsqueeze(-1), average, quats[len(times) // 2])
        spacing = 1.0 / max(len(times) - 1, 1)
        shown = [(view, means[min(round(view.time / spacing), len(times) - 1)].double().numpy()) for view in views]
        largest = np.zeros(len(rows))
        for view, positions in shown:
            largest = np.maximum(largest, pixels_per_unit(view.camera, positions))
        # Children that no view shows are judged as if they lay in the middle of the scene.
        largest[largest == 0] = prepared.scene.sampling.reference
        self.rates = torch.from_numpy(largest).to(self.means.dtype)


def pixels_per_unit(camera: Camera, positions: NDArray[np.float64]) -> NDArray[np.float64]:
    """f |x - c| / Z^2, the norm of the Jacobian of the projection, at each of the positions [n, 3] in view; else 0."""
    points, depth = camera.project(positions)
    inside = (points >= 0).all(1) & (points[:, 0] <= camera.width) & (points[:, 1] <= camera.height)
    distance = np.linalg.norm(positions - camera.center, axis=1)
    rate = max(camera.fx, camera.fy) * distance / np.maximum(depth, constants.NEAR) ** 2
    return np.where(inside & (depth > constants.NEAR), rate, 0.0)


class ResidualSignal(TimeSignal):
    """Colour and opacity that the residual adds, less their means over time; errors are in [0, 1].

    A residual that depends on the view is averaged over some eyes of the training views.
    """

    def __init__(self, prepared: PreparedScene, views: Sequence[View], times: Sequence[float], bound: float) -> None:
        self._prepared = prepared
        most = MOST_EYES if prepared.residual_depends_on_view else 1
        self.eyes = [view.camera.center for view in chosen(views, most)] or [np.zeros(3)]
        everything = torch.arange(prepared.children)
        first = prepared.residual(times[0], self.eyes, everything[:1])
        self.child_scales = first.new_ones(prepared.children)
        self.value_scales = first.new_ones(4)
        self.state = first.new_zeros(prepared.children, 4)
        rest = first.new_zeros(prepared.children)
        for rows in pieces(everything):
            sampled = torch.stack([self.at(time, rows) for time in times])
            self.state[rows] = sampled.mean(0)
            rest[rows] = (sampled - self.state[rows]).abs().amax(dim=(0, 2))
        self.moving: Bool[Tensor, " child"] = ~(rest <= bound)
        self.rest_errors = rest[~self.moving]

    def at(self, time: float, rows: Int64[Tensor, " row"]) -> Float[Tensor, "row 4"]:
        return self._prepared.residual(time, self.eyes, rows) - self.state[rows]

    def errors(
        self, rows: Int64[Tensor, " row"], found: Float[Tensor, "row 4"], expected: Float[Tensor, "row 4"]
    ) -> Float[Tensor, " row"]:
        largest: Tensor = (found - expected).abs().amax(-1)
        return largest

    def view_errors(self, views: Sequence[View]) -> Float[Tensor, "view child"]:
        """How far the colour that each of some `views` has at its time is from the mean over eyes."""
        rows = torch.arange(self._prepared.children)
        if len(self.eyes) == 1 or not len(rows):
            return self.state.new_zeros(0, len(rows))
        found = []
        for view in chosen(views, CHECKED_VIEWS):
            mean = self.at(view.time, rows) + self.state
            seen = self._prepared.residual(view.time, [view.camera.center], rows)
            found.append((seen - mean)[:, :3].abs().amax(-1))
        return torch.stack(found)


def _unit(rotations: Float[Tensor, "row 4"]) -> Float[Tensor, "row 4"]:
    """Unit quaternions of offsets from the identity."""
    quats = rotations.clone()
    quats[:, 0] += 1
    return quats / quats.norm(dim=-1, keepdim=True)


def _conjugate(quats: Float[Tensor, "row 4"]) -> Float[Tensor, "row 4"]:
    return quats * quats.new_tensor([1.0, -1.0, -1.0, -1.0])
