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
    # As in the paper: one view per step. Growth is half as frequent per view as with batches of four.
    "paper": {
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
}
