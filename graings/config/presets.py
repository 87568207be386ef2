"""Presets: named sets of defaults. Options that a preset does not name keep the defaults of their section."""

from __future__ import annotations

from typing import Any, Final

PAPER_ITERATIONS: Final = 30_000

PRESETS: Final[dict[str, dict[str, Any]]] = {
    "draft": {
        # Many views of few Gaussians reconstruct motion sooner than few views of many Gaussians.
        "iterations": 1_100,
        "batch": 4,
        # With so few Gaussians reduced images cost no detail, and no seed gives a bad result.
        "low_resolution_until": 15_000,
        "init": {"max_points": 6_000},
        # So few steps do not separate view dependence from change over time.
        "scene": {"residual_sh_degree": 0},
        # Gradients of the first steps correct the overall colour and do not show where detail is missing.
        "density": {
            "statistics_from": 2_000,
            "gradient_threshold": 3e-4,
            "min_observations": 20,
            "max_anchors": 1_600,  # a floor of the background's colour could use up 1 200
        },
        "evaluation": {"checkpoint_every": 250},  # a first model to look at after half a minute
        "rates": {"offsets": (0.03, 1e-3), "matrices": (8e-3, 2e-4)},
    },
    "standard": {},
    "fine": {"iterations": 15_000},
    # One view per step, with all of our additions. Growth is twice as frequent per view as with batches of four.
    "long": {
        "iterations": PAPER_ITERATIONS,
        "batch": 1,
        "density": {"grow_every": 100, "gradient_threshold": 3e-4},
        # Lower final rates than in short runs, which were better with higher ones.
        "rates": {
            "offsets": (0.02, 2e-4),
            "features": (0.0075, 0.0015),
            "log_scales": (0.007, 0.0014),
            "color": (0.008, 5e-5),
        },
    },
    # What the paper prints, and nothing else. Options that it fixes are named even where they are the default. Where it
    # is silent: docs/method.md.
    "paper": {
        "iterations": PAPER_ITERATIONS,
        "batch": 1,
        "warmup": 3_000,
        "average_from": PAPER_ITERATIONS,
        "time_window": 1.0,
        "low_resolution_until": 0,
        "matrix_optimizer": "adam",
        "network_precision": "float32",
        "capture": {"max_side": 800, "background": "white"},
        "scene": {
            "children": 10,
            "time_frequencies": 6,
            "residual_scale": 0.1,
            "time_conditioning": "concatenated",
            "relative_scales": False,
            "residual_sh_degree": 0,
            "color_sh_degree": 1,
            "reflection": False,
            "opacity_view": True,
            "child_opacity_offsets": True,
            "projected_clip": False,
            "blur": 0.3,
        },
        # A cloud is not thinned. Where there is none, points of the visual hull stand for those on surfaces.
        "init": {"max_points": 2_000_000},
        "loss": {
            "ssim": 0.2,
            "temporal": 0.01,
            "temporal_sum": True,
            "deformation": 0.001,
            "residual": 0.01,
            "squared": 0.0,
            "alpha": 0.0,
            "rigidity": 0.0,
        },
        "density": {
            "statistics_from": 500,
            "grow_from": 1_500,
            "grow_until": 20_000,
            "grow_every": 100,
            "gradient_threshold": 2e-4,
            "max_growth": None,
            "max_anchors": None,
            "memory_mb": 16_384,  # protects the machine; 300 000 anchors
            "new_anchor_opacity": 0.1,
            "prune_from": 24_600,  # 80 % of the joint phase
            "unseen_pixels": 0.0,
        },
        "guard": {"skip_only": True},
        "plan": {"mode": "off"},  # the residual is part of the method, whether a scene needs it or not
    },
}
