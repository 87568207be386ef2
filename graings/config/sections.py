"""The sections of the options: every number a user may choose, with its bounds, default and one line of help.

Each section is read by one package only, named in its docstring. Iteration marks are those of the paper's
30 000-iteration schedule and are scaled with `iterations`, so that a shorter run keeps the shape of the schedule.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field


class ConfigSection(BaseModel):
    """Strict base of all parts: unknown fields and non-finite numbers are refused; values are frozen."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


Channel = Annotated[float, Field(ge=0, le=1)]
FirstAndLast = tuple[Annotated[float, Field(ge=0)], Annotated[float, Field(ge=0)]]


class CaptureConfig(ConfigSection):
    """How images are read. Owner: `graings.capture`."""

    max_side: int | None = Field(
        400, ge=16, le=16384, description="Longest image side in px; null keeps the files' size."
    )
    background: Literal["auto", "white", "black"] | tuple[Channel, Channel, Channel] = Field(
        "auto",
        description="Colour behind transparent pixels, and what needs no Gaussians where it is seen: white, black or "
        "[r, g, b] in [0, 1]. auto: the colour around what opaque pictures show if it is one, else white.",
    )
    times_from_names: bool = Field(
        False, description="Take times from the number in the file name where the capture gives none."
    )
    test_every: int = Field(
        8,
        ge=2,
        description="COLMAP, transforms.json: every n-th image by name is held out for test if there is no split; of "
        "a rig of n or more cameras every n-th camera.",
    )
    cache_mb: int = Field(1024, ge=16, description="Memory for decoded images in MB.")

    def background_rgb(self) -> tuple[float, float, float]:
        """The background as RGB in [0, 1]; white while it is left to the pictures."""
        named = {"auto": (1.0, 1.0, 1.0), "white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0)}
        return named[self.background] if isinstance(self.background, str) else self.background


class SceneConfig(ConfigSection):
    """Shape of the model and the paper's structural ablations. Owner: `graings.scene`."""

    children: int = Field(10, ge=1, le=32, description="Child Gaussians per anchor (k).")
    feature_dim: int = Field(64, ge=1, le=256, description="Length of the anchor feature (d_f).")
    head_width: int = Field(96, ge=4, le=512, description="Hidden width of the colour, opacity and residual heads.")
    static_width: int = Field(64, ge=4, le=512, description="Hidden width of StaticMLP.")
    deform_width: int = Field(128, ge=4, le=1024, description="Hidden width of DeformNet.")
    deform_depth: int = Field(3, ge=1, le=12, description="Hidden layers of DeformNet.")
    position_frequencies: int = Field(6, ge=0, le=16, description="Octaves of the position encoding in DeformNet.")
    time_conditioning: Literal["factorized", "concatenated"] = Field(
        "factorized",
        description="How time enters DeformNet. factorized: W (phi(x) * psi(t)), motions of a position weighted by a "
        "function of time; concatenated: one network of position and time.",
    )
    time_frequencies: int = Field(6, ge=0, le=16, description="Octaves of the time encoding (L).")
    time_width: int = Field(
        256, ge=4, le=4096, description="Hidden width of psi, the function of time in a product; it runs once a frame."
    )
    residual_scale: float = Field(0.1, ge=0, le=1, description="Bound of the appearance residual (eta).")
    deformation: Literal["child", "anchor", "none"] = Field(
        "child", description="child: an offset per Gaussian (the method); anchor: broadcast per anchor; none: static."
    )
    stop_gradient: bool = Field(True, description="Detach the canonical position before DeformNet (Eq. 7).")
    single_mlp: bool = Field(False, description="Ablation: one network for canonical and temporal geometry.")
    residual: bool = Field(True, description="Temporal appearance residual (Eq. 12).")
    residual_sh_degree: int = Field(
        2,
        ge=0,
        le=3,
        description="Degree up to which the residual of colour sees spherical harmonics of the viewing direction; 0 is "
        "Eq. 12, which sees none.",
    )
    residual_stop_gradient: bool = Field(True, description="Detach the anchor feature before the residual field.")
    canonical: bool = Field(True, description="Ablation when off: no canonical geometry branch and no warm-up.")
    color_sh_degree: int = Field(
        3,
        ge=1,
        le=3,
        description="Degree up to which the colour head sees spherical harmonics of the viewing direction; 1 is the "
        "direction itself.",
    )
    reflection: bool = Field(
        True,
        description="Let the colour head also see the viewing direction mirrored at a normal that it reads from the "
        "feature: where a highlight lies.",
    )
    blur: float = Field(
        0.1,
        ge=0,
        le=10,
        description="Low-pass of the picture: variance added to every footprint, in px^2 of the finer training "
        "views, and as large on the scene in all others and in other pictures. A pixel's own box has 1/12, 3DGS 0.3.",
    )
    opacity_view: bool = Field(False, description="Feed the viewing direction to the opacity head, as the paper does.")
    projected_clip: bool = Field(True, description="Let clipped values receive gradients that point back inside.")


class InitConfig(ConfigSection):
    """The first anchors. Owner: `graings.training.initialization.initial_scene`."""

    points: int = Field(240_000, ge=16, le=2_000_000, description="Random points where the capture has no cloud.")
    min_mask_fraction: float = Field(
        0.6,
        ge=0,
        le=1,
        description="Least share of views whose mask a random point must hit to stay; where more agree on enough, more "
        "must. Where pictures are filled, places that pairs of them agree on are taken instead. 0 leaves random points "
        "as they are.",
    )
    max_points: int = Field(
        20_000,
        ge=16,
        description="At most this many points become first anchors, wherever they come from; of a cloud's, or those "
        "that pictures agree on, no more than `density.max_anchors` either.",
    )
    voxel_size: float | None = Field(
        None, ge=1e-9, description="Finest anchor cell, normalised; null: 0.7 px of the finer training views."
    )
    offset_std: float = Field(0.3, ge=0, le=10, description="Spread of the first child offsets in units of s_a.")
    opacity: float = Field(0.1, gt=0.004, lt=0.99, description="Opacity score that all children start with.")


class LossConfig(ConfigSection):
    """Weights of Eq. 14-18, alpha and rigidity; 0 leaves a term out. Owner: `graings.training.losses`."""

    ssim: float = Field(0.2, ge=0, le=1, description="Weight of D-SSIM in the photometric loss.")
    squared: float = Field(
        10.0,
        ge=0,
        description="Weight of the mean squared error, which joins the photometric loss after the last growth. Not in "
        "the paper: absolute differences let a few large errors stand.",
    )
    alpha: float = Field(
        0.03,
        ge=0,
        description="Weight of the difference between the opacity drawn and the pictures' alpha, where they have one. "
        "Not in the paper: what has the background's colour may else be a hole, and empty space be veiled by it.",
    )
    temporal: float = Field(0.01, ge=0, description="lambda_1, temporal smoothness of the position offset.")
    deformation: float = Field(0.001, ge=0, description="lambda_2, magnitude of the deformation.")
    residual: float = Field(0.01, ge=0, description="lambda_3, magnitude of the appearance residual.")
    rigidity: float = Field(
        0.02,
        ge=0,
        description="Weight of the strain between the instants of a step, that is how much neighbouring Gaussians come "
        "apart. Not in the paper; a step of one view has none.",
    )
    temporal_share: float = Field(0.1, gt=0, le=1, description="Share of drawn children in the temporal term per step.")


class DensityConfig(ConfigSection):
    """Growing and pruning. Owner: `graings.training.density.growth`. Marks are of the 30 000 schedule."""

    statistics_from: int = Field(500, ge=0, description="First iteration of the growth statistics.")
    grow_from: int = Field(1_500, ge=0, description="First growth.")
    grow_until: int = Field(20_000, ge=0, description="Last growth.")
    grow_every: int = Field(50, ge=1, description="Iterations between growths (not scaled).")
    gradient_threshold: float = Field(2e-4, gt=0, description="tau_g, mean screen gradient in NDC units.")
    min_observations: int = Field(40, ge=0, description="tau_obs, times a child must have been drawn (not scaled).")
    levels: int = Field(3, ge=1, le=6, description="Cell sizes 4^(levels-1) v ... v.")
    new_anchor_opacity: float | None = Field(
        None,
        gt=0.004,
        lt=0.99,
        description="Opacity score that a new anchor's brightest child starts with; null inherits the parent's.",
    )
    max_anchors: int = Field(12_000, ge=16, description="Anchors up to which growth may go; the largest gradients win.")
    memory_mb: int = Field(
        4096, ge=1, description="Memory in MB that anchors and one training step may take; growth stops where it ends."
    )
    prune_from: int = Field(24_600, ge=0, description="First pruning: about 80 % of the joint phase.")
    prune_until: int = Field(29_000, ge=0, description="Last pruning.")
    prune_every: int = Field(500, ge=1, description="Iterations between prunings.")
    prune_opacity: float = Field(0.005, ge=0, description="Anchors whose summed child opacity stays below are removed.")
    prune_min_views: int = Field(
        80, ge=1, description="Views an anchor must have been seen in before it may go (not scaled)."
    )


class RatesConfig(ConfigSection):
    """Learning rates, first and last (log-linear between). Owner: `graings.training.optimizer`.

    They are Adam's; `matrices` is that of the matrices in `static` and `deformation` but for their last layers, unless
    `matrix_optimizer` is adam.
    """

    offsets: FirstAndLast = Field((0.02, 1e-3), description="Child offsets, in units of s_a.")
    features: FirstAndLast = Field((0.0075, 0.003), description="Anchor features.")
    log_scales: FirstAndLast = Field((0.007, 0.003), description="log s_a of the anchors.")
    opacity_offsets: FirstAndLast = Field((0.02, 0.002), description="What an anchor adds to its opacity logits.")
    static: FirstAndLast = Field((0.004, 0.0004), description="StaticMLP.")
    color: FirstAndLast = Field((0.008, 2e-4), description="Colour head, with the normals of its mirror.")
    opacity: FirstAndLast = Field(
        (0.0007, 7e-6),
        description="Opacity head. At three times as much a scene may fade before its colours fit, and stay so.",
    )
    residual: FirstAndLast = Field((0.002, 2e-5), description="Residual field of the appearance.")
    deformation: FirstAndLast = Field((2e-3, 5e-5), description="DeformNet.")
    matrices: FirstAndLast = Field(
        (2e-3, 5e-5), description="Hidden matrices of StaticMLP and DeformNet, where Muon steps them."
    )


class GuardConfig(ConfigSection):
    """When a step is limited and when training goes back. Owner: `graings.training.guard.guard`."""

    clip: float = Field(
        100.0, gt=1, le=1e6, description="A group's gradient above this many times its usual size is limited to it."
    )
    excess: float = Field(
        2.0, gt=1, le=100, description="A mean loss above this many times the best one counts as diverging."
    )
    patience: int = Field(200, ge=1, description="Steps in a row that may diverge before training goes back.")
    rollbacks: int = Field(
        3, ge=0, le=20, description="Times training may go back to a good moment, each time with half the rates."
    )
    snapshot_every: int = Field(500, ge=1, description="Iterations between the moments kept to go back to.")
    check_every: int = Field(100, ge=1, description="Iterations between checks of all parameters and moments.")


class EvaluationConfig(ConfigSection):
    """Held-out evaluation and checkpoints during a run. Owner: `graings.training.run`."""

    first: int = Field(50, ge=1, description="Iteration of the first evaluation.")
    factor: float = Field(1.5, gt=1, description="Each evaluation comes this many times later than the last.")
    views: int = Field(8, ge=1, description="Held-out views per evaluation during training (all at the end).")
    checkpoint_every: int = Field(500, ge=1, description="Iterations between checkpoints.")
