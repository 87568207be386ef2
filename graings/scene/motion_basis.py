"""MotionBasis: a prepared scene over time as states that do not change and a few functions of time.

At a time t in [0, 1], for each of N children, with the weights a and functions b of two bases (`TimeBasis`):

    mean      = means + sum_r a_r b_r(t)[0:3]                      normalised units
    rotation  = quats (x) ((1, 0, 0, 0) + sum_r a_r b_r(t)[3:7])   (w, x, y, z), Hamilton product, not normalised
    log-scale = log_scales + sum_r a_r b_r(t)[7:10]                clipped to LOG_SCALE_RANGE
    colour    = c(v) + color_offsets + sum_r a'_r b'_r(t)[0:3]     clipped to [0, 1]
    opacity   = opacities + sum_r a'_r b'_r(t)[3]                  not drawn at most 1/255

a, b are `geometry`, with ten values; a', b' are `residual`, with four. c(v) is the canonical colour, which depends on
the viewing direction but not on time (`PreparedScene.canonical_colors`). Children without motion above the bound have
no weights: `geometry.rows` and `residual.rows` are the children that have some. A scene of one instant, and one
without motion, have rank 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from time import perf_counter
from typing import Final

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from graings.camera.camera import View
from graings.scene.children import LOG_SCALE_RANGE, Geometry, quaternion_product
from graings.scene.motion_report import BasisReport, ErrorStatistics, MotionBasisReport
from graings.scene.motion_signals import MOST_VIEWS, GeometrySignal, ResidualSignal, chosen
from graings.scene.prepared import PreparedScene
from graings.scene.prepared_appearance import BasisResidual
from graings.scene.prepared_geometry import BasisGeometry
from graings.scene.time_basis import TimeBasis, between, fit, quantile

# Bounds for the 0.99 quantile of errors unless others are given.
PLAYER_PIXELS: Final = 0.5
LEVELS: Final = 1.0

# Errors of single Gaussians average out where several are blended: with this, images differ by half a grey level RMS
# (docs/experiments/serving.md).
VIEW_LEVELS: Final = 4.0

# Times at which functions are learned; as many between them are checked. At least SAMPLES_PER_PERIOD of the shortest
# period that the networks' encoding of time has.
LEAST_TIMES: Final = 64
MOST_TIMES: Final = 128
SAMPLES_PER_PERIOD: Final = 8


@dataclass(frozen=True, slots=True, eq=False)
class MotionBasis:
    """See the module. All floating tensors are float32; rows are the children of the `PreparedScene`."""

    slots: Int64[Tensor, " child"]  # flat slots (anchor * k + child) in the scene, ascending
    uids: Int64[Tensor, " child"]
    means: Float[Tensor, "child 3"]
    quats: Float[Tensor, "child 4"]  # any length > 0
    log_scales: Float[Tensor, "child 3"]
    opacities: Float[Tensor, " child"]  # with `opacity_view` from the middle of the training views
    color_offsets: Float[Tensor, "child 3"]
    opacity_offsets: Float[Tensor, " child"]  # the residual's part of `opacities`
    pixel_rates: Float[Tensor, " child"]  # px per unit of length in the training view that shows it largest
    geometry: TimeBasis
    residual: TimeBasis
    report: MotionBasisReport

    @property
    def bytes(self) -> int:
        """Memory of all arrays."""
        floats = (self.means, self.quats, self.log_scales, self.opacities, self.color_offsets)
        numbers = (self.slots, self.uids)
        return (
            sum(array.numel() * array.element_size() for array in (*floats, *numbers))
            + self.geometry.bytes
            + self.residual.bytes
        )

    def prepared(self, exact: PreparedScene, *, view_levels: float = VIEW_LEVELS) -> PreparedScene:
        """`exact`, the scene that this is the basis of, with motion and residual from the basis.

        The residual's colours remain exact where averaging them over views changes more than 1 % of them by more than
        `view_levels` of 255.
        """
        dtype = exact.scene.extent.dtype
        states = [state.to(dtype) for state in (self.means, self.quats, self.log_scales)]
        residual = torch.cat([self.color_offsets, self.opacity_offsets.unsqueeze(1)], dim=1).to(dtype)
        seen = self.report.residual_of_views
        return exact.with_basis(
            BasisGeometry(self.geometry, *states),
            BasisResidual(self.residual, residual, exact_colors=seen.p99 > view_levels),
        )

    def geometry_at(self, time: float) -> Geometry:
        """Means, quaternions and log-scales of all children at `time`."""
        offsets = self.geometry.offsets(time)
        moved = self.means.new_zeros(len(self.means), 10).index_copy(0, self.geometry.rows, offsets)
        moved[:, 3] += 1
        log_scales = (self.log_scales + moved[:, 7:]).clamp(*LOG_SCALE_RANGE)
        return self.means + moved[:, :3], quaternion_product(self.quats, moved[:, 3:7]), log_scales

    def residual_at(self, time: float) -> Float[Tensor, "child 4"]:
        """`color_offsets` and `opacities` of all children at `time`."""
        state = torch.cat([self.color_offsets, self.opacities.unsqueeze(1)], dim=1)
        return state.index_add(0, self.residual.rows, self.residual.offsets(time))

    @staticmethod
    @torch.inference_mode()
    def of(
        prepared: PreparedScene, views: Sequence[View], *, pixels: float = PLAYER_PIXELS, levels: float = LEVELS
    ) -> MotionBasis:
        """The basis of `prepared` within `pixels` in the training `views` and `levels` of 255 in colour and opacity.

        Both hold for 99 % of the children that move and the times between those that the basis was learned from.
        Raises `ValueError` for a bound that is not positive and for a scene whose motion is not finite.
        """
        if not (pixels > 0 and levels > 0):
            raise ValueError(f"the bounds of a motion basis must be above 0, got {pixels} px and {levels} levels")
        started = perf_counter()
        views = chosen(views, MOST_VIEWS)
        times = learned_times(prepared)
        checked = between(times) or list(times)
        geometry = GeometrySignal(prepared, views, times, pixels)
        moving, moving_report = _fitted(geometry, times, checked, pixels, 1.0)
        residual = ResidualSignal(prepared, views, times, levels / 255)
        changing, changing_report = _fitted(residual, times, checked, levels, 255.0)
        middle = views[len(views) // 2].camera.center if views else (0.0, 0.0, 0.0)
        opacities = prepared.canonical_opacities(middle) + residual.state[:, 3]
        return MotionBasis(
            slots=prepared.slots,
            uids=prepared.uids,
            means=geometry.means.float(),
            quats=geometry.quats.float(),
            log_scales=geometry.log_scales.float(),
            opacities=opacities.float(),
            color_offsets=residual.state[:, :3].float().contiguous(),
            opacity_offsets=residual.state[:, 3].float().contiguous(),
            pixel_rates=geometry.child_scales.float(),
            geometry=moving,
            residual=changing,
            report=MotionBasisReport(
                children=prepared.children,
                views=len(views),
                times=len(checked),
                geometry=moving_report,
                residual=changing_report,
                residual_of_views=_statistics(255 * residual.view_errors(views)),
                seconds=perf_counter() - started,
            ),
        )


def learned_times(prepared: PreparedScene) -> list[float]:
    """Evenly spaced times from 0 to 1, close enough for the networks' encoding of time; one for a static scene."""
    if not prepared.scene.temporal:
        return [0.0]
    per_period = SAMPLES_PER_PERIOD * 2.0 ** (prepared.scene.config.time_frequencies - 1) / (2 * torch.pi)
    count = min(MOST_TIMES, max(LEAST_TIMES, round(per_period))) + 1
    return [number / (count - 1) for number in range(count)]


def _fitted(
    signal: GeometrySignal | ResidualSignal, times: Sequence[float], checked: Sequence[float], bound: float, unit: float
) -> tuple[TimeBasis, BasisReport]:
    """The basis of a signal, whose errors times `unit` are in the unit of the bound."""
    basis, found = fit(signal, signal.moving.nonzero().squeeze(-1), times, checked, bound / unit)
    found, rest = unit * found, unit * signal.rest_errors
    return basis, BasisReport(
        bound=bound,
        rank=basis.rank,
        samples=len(basis.functions),
        children=len(basis.rows),
        bytes=basis.bytes,
        error=_statistics(found, rest),
    )


def _statistics(found: Tensor, rest: Tensor | None = None) -> ErrorStatistics:
    """Of the errors `found`; those of the `rest` count for the largest only."""
    largest = [float(part.max()) for part in (found, rest) if part is not None and part.numel()]
    return ErrorStatistics(
        rms=float(found.square().mean().sqrt()) if found.numel() else 0.0,
        p99=quantile(found),
        max=max(largest, default=0.0),
    )
