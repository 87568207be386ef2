"""The sections of the options that describe images, model and loss: numbers with default, bounds and a description.

Those of the optimisation are in `optimization`. Each section is read by one package, named in its docstring.
Iterations "in a schedule of 30 000", the paper's, are scaled with `iterations`, so that a shorter run has the same
proportions. Descriptions are shown by `graings options`.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from graings.constants import MAX_IMAGE_SIDE


class ConfigSection(BaseModel):
    """Strict base class: unknown fields and non-finite numbers are refused; values are frozen."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


Channel = Annotated[float, Field(ge=0, le=1)]


class CaptureConfig(ConfigSection):
    """How images are read. Read by `graings.capture`."""

    max_side: int | None = Field(
        400,
        ge=16,
        le=MAX_IMAGE_SIDE,
        description="Longest image side in px; larger images are scaled down. null: keep the size of the files.",
    )
    background: Literal["auto", "white", "black"] | tuple[Channel, Channel, Channel] = Field(
        "auto",
        description="Colour behind transparent pixels, and behind the scene when it is rendered: white, black or "
        "[r, g, b] in [0, 1]. auto: the colour of the borders of opaque images if they have a single one, else white.",
    )
    times_from_names: bool = Field(
        False, description="Read the time of a frame from the number in its file name if the capture has no times."
    )
    rig: bool = Field(
        False,
        description="Calibrated still cameras with a folder of frames each: every frame of the folder NAME has the "
        "camera of the calibrated image NAME, and the number in its file name is its time.",
    )
    orientation: Literal["auto", "stored", "upright"] = Field(
        "auto",
        description="Pictures with an EXIF orientation. stored: pixels as they are in the file, as COLMAP reads them; "
        "upright: turned as viewers show them; auto: as stored, unless the size in px of the camera fits only the "
        "turned picture.",
    )
    test_every: int = Field(
        8,
        ge=2,
        description="COLMAP and transforms.json without a split: every n-th image by name is held out for testing; "
        "with a rig of n or more cameras, every n-th camera.",
    )
    cache_mb: int = Field(1024, ge=16, description="Memory for the cache of decoded images, MB.")

    def background_rgb(self) -> tuple[float, float, float]:
        """The background as RGB in [0, 1]; white for `auto`, before the images have been read."""
        named = {"auto": (1.0, 1.0, 1.0), "white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0)}
        return named[self.background] if isinstance(self.background, str) else self.background


class SceneConfig(ConfigSection):
    """Structure of the model, with the paper's structural ablations. Read by `graings.scene`."""

    children: int = Field(10, ge=1, le=32, description="Child Gaussians per anchor (k).")
    feature_dim: int = Field(64, ge=1, le=256, description="Dimension of the anchor feature (d_f).")
    head_width: int = Field(96, ge=4, le=512, description="Hidden width of the colour, opacity and residual heads.")
    static_width: int = Field(64, ge=4, le=512, description="Hidden width of StaticMLP.")
    deform_width: int = Field(128, ge=4, le=1024, description="Hidden width of DeformNet.")
    deform_depth: int = Field(3, ge=1, le=12, description="Number of hidden layers of DeformNet.")
    position_frequencies: int = Field(
        6, ge=0, le=16, description="Number of frequencies (octaves) of the position encoding in DeformNet."
    )
    time_conditioning: Literal["factorized", "concatenated"] = Field(
        "factorized",
        description="How DeformNet depends on time. factorized: W (phi(x) * psi(t)), the elementwise product of a "
        "network of position and a network of time; concatenated: one network of position and time, as in the paper.",
    )
    time_frequencies: int = Field(
        6, ge=0, le=16, description="Number of frequencies (octaves) of the time encoding (L)."
    )
    time_width: int = Field(
        256,
        ge=4,
        le=4096,
        description="Hidden width of psi, the network of time in the factorized DeformNet; evaluated once per frame.",
    )
    residual_scale: float = Field(0.1, ge=0, le=1, description="Bound of the temporal appearance residual (eta).")
    deformation: Literal["child", "anchor", "none"] = Field(
        "child",
        description="child: one deformation per Gaussian (the paper's method); anchor: one per anchor, shared by its "
        "children; none: a static scene.",
    )
    relative_scales: bool = Field(
        True,
        description="Log-scales from StaticMLP are relative to log s_a, the size of the anchor. false: rho_can is "
        "StaticMLP's alone, in units of the scene's extent, as in Eq. 5.",
    )
    stop_gradient: bool = Field(True, description="Stop the gradient from DeformNet to the canonical position (Eq. 7).")
    single_mlp: bool = Field(
        False,
        description="Ablation: a single network for canonical geometry and deformation. Not with `deformation=none`.",
    )
    residual: bool = Field(True, description="Temporal appearance residual (Eq. 12).")
    residual_sh_degree: int = Field(
        2,
        ge=0,
        le=3,
        description="Highest degree of the spherical harmonics of the viewing direction that the colour residual "
        "receives; 0: none, as in Eq. 12.",
    )
    canonical: bool = Field(True, description="false, as an ablation: no network of canonical geometry and no warm-up.")
    color_sh_degree: int = Field(
        3,
        ge=1,
        le=3,
        description="Highest degree of the spherical harmonics of the viewing direction that the colour head receives; "
        "1: the direction itself.",
    )
    reflection: bool = Field(
        True,
        description="Also give the colour head the viewing direction reflected at a normal predicted from the anchor "
        "feature, for specular highlights.",
    )
    blur: float = Field(
        0.1,
        ge=0,
        le=10,
        description="Low-pass filter: variance added to every projected Gaussian, in px^2 of the finer training views; "
        "other views use the same width in the scene. A pixel's box filter has 1/12; 3DGS uses 0.3.",
    )
    opacity_view: bool = Field(False, description="Give the opacity head the viewing direction, as in the paper.")
    child_opacity_offsets: bool = Field(
        False, description="Learn an offset of the opacity logit for each child instead of one for each anchor."
    )
    projected_clip: bool = Field(
        True, description="Let clipped values receive gradients that move them back into their range."
    )

    @model_validator(mode="after")
    def _single_mlp_moves(self) -> SceneConfig:
        if self.single_mlp and self.deformation == "none":
            raise ValueError(
                "scene.single_mlp moves the Gaussians, and with scene.deformation=none nothing moves. Set one only."
            )
        return self


class InitConfig(ConfigSection):
    """The initial anchors. Read by `graings.training.initialization.initial_scene`."""

    points: int = Field(
        240_000, ge=16, le=2_000_000, description="Number of random candidate points if the capture has no point cloud."
    )
    min_mask_fraction: float = Field(
        0.6,
        ge=0,
        le=1,
        description="Visual hull: smallest fraction of the views in whose masks a random point must lie to be kept; "
        "raised automatically if enough points remain. Images without a mask are triangulated in pairs instead. "
        "0: keep all random points.",
    )
    max_points: int = Field(
        20_000,
        ge=16,
        description="Maximum number of initial anchors. Points of a cloud and triangulated points are also limited to "
        "`density.max_anchors`.",
    )
    voxel_size: float | None = Field(
        None,
        ge=1e-9,
        description="Side of the finest anchor voxel in normalised units; null: 0.7 px of the finer training views.",
    )
    offset_std: float = Field(
        0.3, ge=0, le=10, description="Standard deviation of the initial child offsets, in units of s_a."
    )
    opacity: float = Field(0.1, gt=0.004, lt=0.99, description="Initial opacity of all children.")


class LossConfig(ConfigSection):
    """Weights of the loss terms, Eq. 14-18, alpha and rigidity; 0 omits a term. Read by `graings.training.losses`."""

    ssim: float = Field(
        0.2, ge=0, le=1, description="Weight of D-SSIM in the photometric loss; L1 has the rest (Eq. 15)."
    )
    squared: float = Field(
        10.0,
        ge=0,
        description="Weight of the mean squared error, which is added to the photometric loss after the last growth. "
        "Not in the paper: L1 alone tolerates a few large errors.",
    )
    alpha: float = Field(
        0.03,
        ge=0,
        description="Weight of the difference between rendered and given alpha, for images with an alpha channel. Not "
        "in the paper: without it surfaces of the background's colour may have holes, and empty space may be opaque.",
    )
    temporal: float = Field(0.01, ge=0, description="lambda_1: temporal smoothness of the deformed positions.")
    temporal_sum: bool = Field(
        False,
        description="Estimate the sum of the temporal term over all pairs of neighbouring training times, as in "
        "Eq. 16, rather than its mean over them.",
    )
    deformation: float = Field(0.001, ge=0, description="lambda_2: magnitude of the deformation.")
    residual: float = Field(0.01, ge=0, description="lambda_3: magnitude of the appearance residual.")
    rigidity: float = Field(
        0.02,
        ge=0,
        description="Weight of local rigidity: how much the distances between neighbouring Gaussians change between "
        "the times of a step's views. Not in the paper; without effect with a batch of 1.",
    )
    temporal_share: float = Field(
        0.1, gt=0, le=1, description="Fraction of the drawn children in the temporal term of each step."
    )
