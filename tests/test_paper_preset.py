"""The preset `paper` is what the paper prints: every number and every equation, with its section, one line each.

How the code behaves under these options is tested in tests/training/test_printed_method.py.
"""

from __future__ import annotations

from typing import Any, Final

import pytest
import torch

from graings import constants
from graings.config import TrainConfig, make_config
from graings.config.schedule import phases
from graings.scene.children import MAX_LOG_SCALE_OFFSET
from tests.models import EYE, tiny_scene

SETUP: Final = "IV-A Implementation Details"
OBJECTIVE: Final = "III-E Training Objectives and Schedule"
SCAFFOLD: Final = "III-B Canonical Anchor-Gaussian Scaffold"
DEFORMATION: Final = "III-C Gaussian-Level Deformation"
APPEARANCE: Final = "III-D Decoupled Appearance Model"

# What is printed, its section, the option that expresses it, and the value that prints it.
PRINTED: Final[tuple[tuple[str, str, str, Any], ...]] = (
    ("total training", SETUP, "iterations", 30_000),
    ("T_w, length of the warm-up", SETUP, "warmup", 3_000),
    ("k, children of an anchor", SETUP, "scene.children", 10),
    ("L, frequencies of the time encoding", SETUP, "scene.time_frequencies", 6),
    ("lambda_1 of L_temp", SETUP, "loss.temporal", 0.01),
    ("lambda_2 of L_def", SETUP, "loss.deformation", 0.001),
    ("lambda_3 of L_res", SETUP, "loss.residual", 0.01),
    ("lambda_ssim", SETUP, "loss.ssim", 0.2),
    ("growth statistics start", SETUP, "density.statistics_from", 500),
    ("first anchor update", SETUP, "density.grow_from", 1_500),
    ("last anchor update", SETUP, "density.grow_until", 20_000),
    ("iterations between anchor updates", SETUP, "density.grow_every", 100),
    ("no opacity pruning in the first 80 % of the joint phase", SETUP, "density.prune_from", 3_000 + 0.8 * 27_000),
    ("nor where a budget is nearly used up: there is none", SETUP, "density.max_anchors", None),
    ("every candidate in a free voxel becomes an anchor", SCAFFOLD, "density.max_growth", None),
    ("Eq. 5: rho_can is StaticMLP's alone", SCAFFOLD, "scene.relative_scales", False),
    ("Eq. 5: a StaticMLP", SCAFFOLD, "scene.canonical", True),
    ("new anchors start with low opacity", SCAFFOLD, "density.new_anchor_opacity", 0.1),
    ("all of their children do", SCAFFOLD, "scene.child_opacity_offsets", True),
    ("warm-up views are sampled from all times", SCAFFOLD, "time_window", 1.0),
    ("Eq. 7: offsets of each Gaussian", DEFORMATION, "scene.deformation", "child"),
    ("Eq. 7: sg(x_can)", DEFORMATION, "scene.stop_gradient", True),
    ("Eq. 7: one network of x_can and gamma(t)", DEFORMATION, "scene.time_conditioning", "concatenated"),
    ("Eq. 7: not the network of Eq. 5", DEFORMATION, "scene.single_mlp", False),
    ("Eq. 10 and 13: a plain clip, with its own derivative", DEFORMATION, "scene.projected_clip", False),
    ("Eq. 11: F_c receives v itself", APPEARANCE, "scene.color_sh_degree", 1),
    ("Eq. 11: F_c receives nothing but f_a and v", APPEARANCE, "scene.reflection", False),
    ("Eq. 11: F_o receives v", APPEARANCE, "scene.opacity_view", True),
    ("Eq. 12: a residual", APPEARANCE, "scene.residual", True),
    ("Eq. 12: eta", APPEARANCE, "scene.residual_scale", 0.1),
    ("Eq. 12: F_res receives no v", APPEARANCE, "scene.residual_sh_degree", 0),
    ("Eq. 14: no squared error", OBJECTIVE, "loss.squared", 0.0),
    ("Eq. 14: no alpha", OBJECTIVE, "loss.alpha", 0.0),
    ("Eq. 14: no rigidity", OBJECTIVE, "loss.rigidity", 0.0),
    ("Eq. 16: the sum over t", OBJECTIVE, "loss.temporal_sum", True),
    ("no averaging of parameters", OBJECTIVE, "average_from", 30_000),
    ("no reduced images", OBJECTIVE, "low_resolution_until", 0),
    ("no intervention in the optimisation", OBJECTIVE, "guard.skip_only", True),
    ("no part left out for a scene", OBJECTIVE, "plan.mode", "off"),
)


def residual_reaches_features() -> bool:
    scene = tiny_scene()
    residual = scene.compose(EYE, 0.4).residual
    assert residual is not None
    (gradient,) = torch.autograd.grad(residual.square().sum(), scene.scaffold.features)
    return bool(gradient.any())


# What is printed, its section, what the code has, and what it should be.
TUPLE: Final = {"anchors", "log_scales", "features"}
LEARNED: Final = {name for name, _ in tiny_scene().scaffold.named_parameters()}
CONSTANTS: Final[tuple[tuple[str, str, Any, Any], ...]] = (
    ("Eq. 3: a learnable tuple, x_a included", SCAFFOLD, LEARNED & TUPLE, TUPLE),
    ("alpha is at most", APPEARANCE, constants.ALPHA_MAX, 0.99),
    ("Eq. 10: bound of the clip of Delta rho", DEFORMATION, MAX_LOG_SCALE_OFFSET, 2.0),
    ("Eq. 12: f_a without sg", APPEARANCE, residual_reaches_features(), True),
)

# Not printed: our choices, with their reasons in docs/method.md. Fixed here so that none changes unnoticed.
READINGS: Final[dict[str, Any]] = {
    "batch": 1,
    "matrix_optimizer": "adam",
    "network_precision": "float32",
    "capture.max_side": 800,
    "capture.background": "white",
    "scene.blur": 0.3,
    "scene.feature_dim": 64,
    "scene.head_width": 96,
    "scene.static_width": 64,
    "scene.deform_width": 128,
    "scene.deform_depth": 3,
    "scene.position_frequencies": 6,
    "loss.temporal_share": 0.1,
    "init.offset_std": 0.3,
    "init.max_points": 2_000_000,
    "init.points": 240_000,
    "init.min_mask_fraction": 0.6,
    "density.gradient_threshold": 2e-4,
    "density.min_observations": 40,
    "density.levels": 3,
    "density.prune_opacity": 0.005,
    "density.prune_until": 29_000,
    "density.prune_every": 500,
    "density.memory_mb": 16_384,
    "rates.anchors": (6e-4, 6e-6),
    "rates.offsets": (0.02, 1e-3),
    "rates.features": (0.0075, 0.003),
    "rates.log_scales": (0.007, 0.003),
    "rates.static": (0.004, 4e-4),
    "rates.color": (0.008, 2e-4),
    "rates.opacity": (7e-4, 7e-6),
    "rates.residual": (0.002, 2e-5),
    "rates.deformation": (0.002, 5e-5),
}


def option(config: TrainConfig, name: str) -> Any:
    value: Any = config
    for part in name.split("."):
        value = getattr(value, part)
    return value


@pytest.mark.parametrize(("what", "section", "name", "value"), PRINTED, ids=[row[0] for row in PRINTED])
def test_the_preset_has_what_is_printed(what: str, section: str, name: str, value: Any) -> None:
    assert option(make_config("paper"), name) == value, f"{section}: {what}"


@pytest.mark.parametrize(("what", "section", "found", "value"), CONSTANTS, ids=[row[0] for row in CONSTANTS])
def test_the_code_has_what_is_printed(what: str, section: str, found: Any, value: Any) -> None:
    assert found == value, f"{section}: {what}"


def test_the_schedule_is_the_printed_one() -> None:
    warmup, joint = phases(make_config("paper"))
    assert (warmup.first, warmup.last, warmup.temporal) == (1, 3_000, False)
    assert (joint.first, joint.last, joint.temporal) == (3_001, 30_000, True)


@pytest.mark.parametrize("name", READINGS)
def test_a_reading_changes_only_on_purpose(name: str) -> None:
    assert option(make_config("paper"), name) == READINGS[name]
