"""PlayerScene: Gaussians with harmonics and a motion basis, all that a player draws from; and what its file says."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, Literal

import torch
from jaxtyping import Float
from numpy.typing import ArrayLike
from pydantic import Field
from torch import Tensor

from graings import constants
from graings.camera.sampling_rate import SamplingRate
from graings.document import Document
from graings.gaussians import Gaussians
from graings.player.columns import Table
from graings.scene.children import LOG_SCALE_RANGE, quaternion_product
from graings.scene.encoding import directions_from
from graings.scene.scene import Composed
from graings.scene.splats import harmonic_basis
from graings.scene.time_basis import TimeBasis

SCHEMA: Final = "graings.player_scene/1"
_Three = tuple[float, float, float]


class CameraFacts(Document):
    """A camera of the capture, in normalised units."""

    name: str = Field(description="As `/render?camera=` takes it: split and number.")
    time: float = Field(ge=0, le=1, description="Time of its picture.")
    world_to_camera: tuple[tuple[float, float, float, float], ...] = Field(description="Three rows, OpenCV axes.")
    intrinsics: tuple[float, float, float, float] = Field(description="fx, fy, cx, cy in px.")
    size: tuple[int, int] = Field(description="Width and height in px.")


class UnitsFacts(Document):
    """Normalised units: x' = scale (x - center), t' = (t - time_start) / time_span."""

    center: _Three = Field(description="Of the scene, in the capture's units.")
    scale: float = Field(description="Normalised units per unit of the capture.")
    up: _Three = Field(description="Vertical axis, unit length.")
    time_start: float = Field(description="The capture's time at t' = 0.")
    time_span: float = Field(description="0: the capture has a single time.")


class CaptureCameras(Document):
    """What a player needs to know of a capture to show pictures of it."""

    units: UnitsFacts = Field(description="How normalised units relate to the capture's.")
    background: _Three = Field(description="RGB in [0, 1].")
    start: CameraFacts = Field(description="The first view.")
    cameras: tuple[CameraFacts, ...] = Field(description="Training cameras, then held-out ones.")


class SamplingFacts(Document):
    """Sampling rates of the training cameras, see `graings.camera.sampling_rate`."""

    extent: float = Field(description="The scene lies within so far of the origin, in normalised units.")
    reference: float = Field(description="Rate at which the low-pass variance is that of `blur`, in px per unit.")
    coarsest: float = Field(description="Lowest rate that is drawn without supersampling, in px per unit.")
    tolerance: float = Field(description="Factor by which a rate may differ and still count as the same.")


class RasterFacts(Document):
    """Numbers that define the image, see docs/rasterizer.md."""

    alpha_min: float = Field(constants.ALPHA_MIN, description="Least alpha that is drawn.")
    alpha_max: float = Field(constants.ALPHA_MAX, description="Cap of the alpha of one Gaussian.")
    near: float = Field(constants.NEAR, description="Least depth that is drawn, in normalised units.")
    frustum_margin: float = Field(constants.FRUSTUM_MARGIN, description="Share of the picture that is kept around it.")
    log_scale_range: tuple[float, float] = Field(LOG_SCALE_RANGE, description="Bounds of log-scales.")


class PositionError(Document):
    """Distance between the file's positions and the model's, in px of the nearest training camera."""

    rms: float = Field(ge=0, description="Root mean square.")
    p99: float = Field(ge=0, description="99th percentile.")
    max: float = Field(ge=0, description="The largest.")


class SceneHeader(Document):
    """The JSON at the beginning of a scene file."""

    schema_name: Literal["graings.player_scene/1"] = Field(
        SCHEMA, alias="schema", description="Kind and version of this document."
    )
    digest: str = Field(description="sha256 of the model.")
    iteration: int = Field(ge=0, description="Iteration of the model.")
    finished: bool = Field(description="Whether training had ended.")
    children: int = Field(ge=0, description="Number of Gaussians.")
    moving: int = Field(ge=0, description="The first so many have weights of `geometry`.")
    changing: int = Field(ge=0, description="The first so many have weights of `residual`.")
    degree: int = Field(ge=0, le=3, description="Highest degree of the harmonics.")
    geometry_rank: int = Field(ge=0, description="Functions of time for positions, rotations and log-scales.")
    residual_rank: int = Field(ge=0, description="Functions of time for colours and opacities.")
    position_error: PositionError = Field(description="Of positions in this file.")
    color_error: float = Field(ge=0, description="RMS error of the harmonics in the training views, in levels of 255.")
    blur: float = Field(ge=0, description="Low-pass variance in px^2 at the reference sampling rate.")
    sampling: SamplingFacts = Field(description="Sampling rates of the training cameras.")
    raster: RasterFacts = Field(description="Numbers that define the image.")
    capture: CaptureCameras = Field(description="Cameras and units of the capture.")
    tables: tuple[Table, ...] = Field(description="The tables that follow the header.")


@dataclass(frozen=True, slots=True, eq=False)
class PlayerScene:
    """N Gaussians in normalised units over time, float32; the notation is that of `graings.scene.motion_basis`.

    Colours are harmonics of the direction from the camera centre to `means`, in the basis of 3DGS, plus the residual.
    Rows of both bases are the first ones.
    """

    means: Float[Tensor, "child 3"]
    quats: Float[Tensor, "child 4"]
    log_scales: Float[Tensor, "child 3"]
    opacities: Float[Tensor, " child"]
    harmonics: Float[Tensor, "child harmonic 3"]
    geometry: TimeBasis
    residual: TimeBasis
    blur: float
    sampling: SamplingRate

    @property
    def degree(self) -> int:
        """Highest degree of the harmonics."""
        return math.isqrt(self.harmonics.shape[1]) - 1

    def __len__(self) -> int:
        return len(self.means)

    def means_at(self, time: float) -> Float[Tensor, "child 3"]:
        """Positions at `time`."""
        return self.means.index_add(0, self.geometry.rows, self.geometry.offsets(time)[:, :3])

    def compose(self, eye: ArrayLike, time: float) -> Composed:
        """The Gaussians at `time` in [0, 1] for the camera centre `eye` [3], as the player draws them."""
        moved = self.means.new_zeros(len(self), 10).index_copy(0, self.geometry.rows, self.geometry.offsets(time))
        changed = self.means.new_zeros(len(self), 4).index_copy(0, self.residual.rows, self.residual.offsets(time))
        moved[:, 3] += 1
        basis = harmonic_basis(directions_from(eye, self.means), self.degree)
        colors = torch.einsum("nk,nkc->nc", basis, self.harmonics) + 0.5 + changed[:, :3]
        rows = torch.arange(len(self))
        gaussians = Gaussians(
            means=self.means + moved[:, :3],
            quats=quaternion_product(self.quats, moved[:, 3:7]),
            log_scales=(self.log_scales + moved[:, 7:]).clamp(*LOG_SCALE_RANGE),
            opacities=(self.opacities + changed[:, 3]).clamp(0.0, 1.0),
            colors=colors.clamp(0.0, 1.0),
            uids=rows,
        )
        return Composed(gaussians, rows, self.blur, self.sampling)
