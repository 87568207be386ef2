"""Presets: named sets of defaults. What a preset does not name is as in the sections."""

from __future__ import annotations

from typing import Any, Final

PAPER_ITERATIONS: Final = 30_000

PRESETS: Final[dict[str, dict[str, Any]]] = {
    "draft": {
        # Many views of few Gaussians: what moves is found sooner than with few views of many.
        "iterations": 1_100,
        "batch": 4,
        # With more Gaussians small pictures cost detail; so few are none the worse, and no seed is bad.
        "low_resolution_until": 15_000,
        "init": {"max_points": 6_000},
        # In so few steps what light does from every side is not told from what it does in time.
        "scene": {"residual_sh_degree": 0},
        # Gradients of the first steps, which find the colour of everything, do not say where detail is missing.
        "density": {
            "statistics_from": 2_000,
            "gradient_threshold": 3e-4,
            "min_observations": 20,
            "max_anchors": 1_600,  # a floor of the background's colour could take all of 1 200
        },
        "evaluation": {"checkpoint_every": 250},  # a look at what there is by then, half a minute from the start
        "rates": {"offsets": (0.03, 1e-3), "matrices": (8e-3, 2e-4)},
    },
    "standard": {},
    "fine": {"iterations": 15_000},
    # As the paper trains: one view a step. With four, half as many rounds of growth a view are enough.
    "paper": {
        "iterations": PAPER_ITERATIONS,
        "batch": 1,
        "density": {"grow_every": 100, "gradient_threshold": 3e-4},
        # These fall further than those of a few thousand steps, which gain by staying higher: measured with them.
        "rates": {
            "offsets": (0.02, 2e-4),
            "features": (0.0075, 0.0015),
            "log_scales": (0.007, 0.0014),
            "color": (0.008, 5e-5),
        },
    },
}
