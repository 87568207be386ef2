"""The sections of the options that describe the optimisation: density, learning rates, guard and evaluation."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from graings.config.sections import ConfigSection

FirstAndLast = tuple[Annotated[float, Field(ge=0)], Annotated[float, Field(ge=0)]]


class DensityConfig(ConfigSection):
    """Growing and pruning of anchors. Read by `graings.training.density`."""

    statistics_from: int = Field(
        500, ge=0, description="First iteration of the growth statistics, in a schedule of 30 000."
    )
    grow_from: int = Field(1_500, ge=0, description="Iteration of the first growth, in a schedule of 30 000.")
    grow_until: int = Field(20_000, ge=0, description="Iteration of the last growth, in a schedule of 30 000.")
    grow_every: int = Field(50, ge=1, description="Iterations between growths (not scaled).")
    gradient_threshold: float = Field(
        2e-4, gt=0, description="tau_g: mean screen-space gradient, NDC units, above which a child grows new anchors."
    )
    min_observations: int = Field(
        40, ge=0, description="tau_obs: how often a child must have been drawn before it may grow (not scaled)."
    )
    levels: int = Field(3, ge=1, le=6, description="Number of voxel sizes for new anchors: 4^(levels-1) v, ..., v.")
    new_anchor_opacity: float | None = Field(
        None,
        gt=0.004,
        lt=0.99,
        description="Initial opacity of a new anchor's most opaque child, or of all its children with "
        "`scene.child_opacity_offsets`; null: that of the parent.",
    )
    max_growth: float | None = Field(
        0.1,
        gt=0,
        description="Largest share of the anchors, or 1 000 if that is more, that one growth may add; candidates with "
        "the largest gradients are preferred. null: no limit, as in the paper.",
    )
    max_anchors: int | None = Field(
        12_000,
        ge=16,
        description="Maximum number of anchors after growth; near it, growth first prunes faint anchors. null: only "
        "`memory_mb` limits growth, and nothing is pruned before `prune_from`, as in the paper.",
    )
    memory_mb: int = Field(
        4096, ge=1, description="Memory budget for the anchors and one training step, MB; growth stops at it."
    )
    prune_from: int = Field(24_600, ge=0, description="Iteration of the first pruning, in a schedule of 30 000.")
    prune_until: int = Field(29_000, ge=0, description="Iteration of the last pruning, in a schedule of 30 000.")
    prune_every: int = Field(500, ge=1, description="Iterations between prunings, in a schedule of 30 000.")
    prune_opacity: float = Field(
        0.005, ge=0, description="Anchors whose summed child opacity stays below this are removed."
    )
    prune_min_views: int = Field(
        80, ge=1, description="How many views must have seen an anchor before it may be removed (not scaled)."
    )
    unseen_pixels: float = Field(
        0.2,
        ge=0,
        description="After the last step, anchors are removed whose children each contribute less than this to each "
        "training view, in px (sum of blending weights). 0: none are.",
    )


class RatesConfig(ConfigSection):
    """Learning rates, first and last, log-linear in between. Read by `graings.training.optimizer`.

    They are those of Adam, except `matrices`: the hidden weight matrices of `static` and `deformation` under Muon.
    """

    offsets: FirstAndLast = Field((0.02, 1e-3), description="Child offsets, in units of s_a.")
    features: FirstAndLast = Field((0.0075, 0.003), description="Anchor features.")
    log_scales: FirstAndLast = Field((0.007, 0.003), description="log s_a of the anchors.")
    anchors: FirstAndLast = Field(
        (6e-4, 6e-6),
        description="Anchor positions, in units of the scene's extent; as those of positions in 3DGS.",
    )
    opacity_offsets: FirstAndLast = Field(
        (0.02, 0.002), description="Offsets of the opacity logits of an anchor's children."
    )
    static: FirstAndLast = Field((0.004, 0.0004), description="StaticMLP.")
    color: FirstAndLast = Field(
        (0.008, 2e-4), description="Colour head, including the network of its reflection normals."
    )
    opacity: FirstAndLast = Field(
        (0.0007, 7e-6),
        description="Opacity head. At three times this rate a scene may become transparent before its colours fit.",
    )
    residual: FirstAndLast = Field((0.002, 2e-5), description="Network of the temporal appearance residual.")
    deformation: FirstAndLast = Field((2e-3, 5e-5), description="DeformNet.")
    matrices: FirstAndLast = Field(
        (2e-3, 5e-5), description="Hidden weight matrices of StaticMLP and DeformNet with matrix_optimizer muon."
    )


class GuardConfig(ConfigSection):
    """Gradient clipping and rollback of a diverging run. Read by `graings.training.guard`."""

    skip_only: bool = Field(
        False,
        description="Only skip steps that are not finite: no gradient is clipped, the loss is not watched, vanished "
        "opacity is not raised, and nothing is rolled back. Training that cannot go on ends as diverged.",
    )
    clip: float = Field(
        100.0,
        gt=1,
        le=1e6,
        description="The gradient norm of a parameter group is clipped to this multiple of its recent median.",
    )
    excess: float = Field(
        2.0, gt=1, le=100, description="A mean loss above this multiple of the best one counts as diverging."
    )
    patience: int = Field(200, ge=1, description="Consecutive diverging steps before training returns to a snapshot.")
    rollbacks: int = Field(
        3, ge=0, le=20, description="Maximum number of returns to a snapshot; each one halves the learning rates."
    )
    snapshot_every: int = Field(500, ge=1, description="Iterations between snapshots.")
    check_every: int = Field(
        100, ge=1, description="Iterations between checks that all parameters and optimizer moments are finite."
    )


class EvaluationConfig(ConfigSection):
    """Held-out evaluation and checkpoints during a run. Read by `graings.training.run`."""

    first: int = Field(50, ge=1, description="Iteration of the first evaluation.")
    factor: float = Field(1.5, gt=1, description="Ratio between the iterations of successive evaluations.")
    views: int = Field(8, ge=1, description="Held-out views per evaluation during training; all of them at the end.")
    checkpoint_every: int = Field(500, ge=1, description="Iterations between checkpoints.")
