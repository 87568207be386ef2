"""Models as .4dgs files, read again by the library that defines them."""

from __future__ import annotations

import fourdgs
import numpy as np
import pytest
import torch

from graings.export.four_d import four_d_file
from graings.export.harmonics_fit import fit_splats
from graings.export.selection import Selection
from graings.render import PreparedScene
from tests.export.models import UNITS, tiny_model

PARTS = 4


def test_in_the_middle_of_each_part_the_file_has_the_state_of_the_model() -> None:
    model = tiny_model()
    found = four_d_file(model, PARTS, 1, Selection())
    scene = fourdgs.read(found.data)
    gaussians = scene.gaussians
    assert gaussians.count == found.records
    assert (found.degree, gaussians.sh_degree) == (1, 1)
    cameras = [view.camera for view in model.views["train"]]
    duration = UNITS.time_span or 1.0
    for part in range(PARTS):
        time = (part + 0.5) / PARTS
        fit = fit_splats(PreparedScene(model.scene), cameras, time, degree=1)
        state = gaussians.state_at(time * duration)
        alive = state["indices"]
        assert len(alive) == len(fit.splats)
        expected = UNITS.points_back(fit.splats.means.double().numpy())
        smallest = fit.splats.log_scales.exp().amin(1).numpy() / UNITS.scale
        distance = np.linalg.norm(expected[:, None] - state["centers"][None], axis=2)
        nearest = distance.argmin(1)
        assert (distance.min(1) <= 0.2 * smallest + 1e-6).all()
        opacities = fit.splats.opacities.clamp_max(0.99).numpy()
        assert np.abs(state["opacity"][nearest] - opacities).max() < 0.01
        scales = gaussians.scales[alive][nearest] * UNITS.scale
        assert np.abs(scales / fit.splats.log_scales.exp().numpy() - 1).max() < 0.05


def test_what_moves_goes_in_a_straight_line_within_a_part() -> None:
    model = tiny_model()
    gaussians = fourdgs.read(four_d_file(model, PARTS, 0, Selection()).data).gaussians
    first, last = (gaussians.state_at(t * (UNITS.time_span or 1.0)) for t in (0.0, 0.999 / PARTS))
    assert first["indices"].tolist() == last["indices"].tolist()
    moved = np.linalg.norm(last["centers"] - first["centers"], axis=1)
    scene = PreparedScene(model.scene)
    eye = model.views["train"][0].camera.center
    begin, end = (scene.compose(eye, t).gaussians.means for t in (0.0, 1 / PARTS))
    true = (end - begin).norm(dim=1).numpy() / UNITS.scale
    assert true.max() > 0
    assert moved.max() == pytest.approx(true.max(), rel=0.1)


def test_a_scene_in_which_nothing_moves_has_one_record_for_each_gaussian_at_all_times() -> None:
    model = tiny_model()
    model.scene.temporal = False
    found = four_d_file(model, PARTS, 0, Selection())
    gaussians = fourdgs.read(found.data).gaussians
    cameras = [view.camera for view in model.views["train"]]
    assert gaussians.count == len(fit_splats(PreparedScene(model.scene), cameras, 0.5, degree=0).splats)
    assert len(gaussians.state_at(0.0)["indices"]) == gaussians.count
    assert len(gaussians.state_at(UNITS.time_span or 1.0)["indices"]) == gaussians.count
    assert float(np.abs(gaussians.motions).max()) == 0.0


def test_nothing_left_is_refused() -> None:
    with pytest.raises(ValueError, match="no splat is left"):
        four_d_file(tiny_model(), PARTS, 0, Selection(sphere=(1e6, 0.0, 0.0, 1.0)))


def test_values_are_finite() -> None:
    gaussians = fourdgs.read(four_d_file(tiny_model(), 2, 2, Selection()).data).gaussians
    for values in (gaussians.positions, gaussians.scales, gaussians.rotations, gaussians.colors, gaussians.motions):
        assert torch.isfinite(torch.from_numpy(np.array(values))).all()
