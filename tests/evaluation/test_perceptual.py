from __future__ import annotations

import hashlib
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from graings.evaluation.metrics import Pair, SplitMetrics, measure, measure_split
from graings.evaluation.perceptual import VGG_FILE, Flip, Lpips, PerceptualDistances, _backbone_problem

NO_FLIP = Flip(None, "not installed")


def noise(seed: int, height: int, width: int) -> np.ndarray:
    return np.random.default_rng(seed).random((height, width, 3))


def test_absent_lpips_weights_are_named_and_never_fetched(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    lpips = Lpips.find()
    assert lpips.reason is not None
    assert lpips(noise(0, 40, 40), noise(1, 40, 40)) is None
    split = measure_split([Pair("v", 0.0, noise(0, 40, 40), noise(1, 40, 40))], PerceptualDistances(lpips, NO_FLIP))
    assert split.lpips_vgg is None
    assert split.lpips_reason == lpips.reason
    assert list(tmp_path.iterdir()) == []


def test_damaged_lpips_weights_are_distinguished_from_absent_ones(tmp_path: Path) -> None:
    file = tmp_path / VGG_FILE
    assert "not installed" in str(_backbone_problem(file))
    file.write_bytes(b"half a download")
    assert not hashlib.sha256(file.read_bytes()).hexdigest().startswith("397923af")
    assert "damaged" in str(_backbone_problem(file))


def test_images_too_small_for_the_network_have_no_lpips() -> None:
    class OneForAll(torch.nn.Module):
        def forward(self, a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
            return (a - b).abs().mean()

    distances = PerceptualDistances(Lpips(OneForAll(), None), NO_FLIP)
    small, large = (measure(Pair("v", 0.0, noise(0, n, n), noise(1, n, n)), distances) for n in (31, 32))
    assert small.lpips_vgg is None
    assert large.lpips_vgg is not None
    split = SplitMetrics.over((small, large), distances)
    assert split.lpips_vgg is None
    assert "under 32 pixels" in str(split.lpips_reason)
    assert SplitMetrics.over((large,), distances).lpips_vgg == large.lpips_vgg


def test_without_its_package_flip_is_null_and_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "flip_evaluator", None)
    flip = Flip.find()
    assert flip(noise(0, 8, 8), noise(1, 8, 8)) is None
    assert "graings[flip]" in str(flip.reason)


def test_flip_is_0_for_equal_images_near_1_for_black_on_white_and_grows_with_the_error() -> None:
    pytest.importorskip("flip_evaluator")
    flip = Flip.find()
    image = 0.2 + 0.6 * noise(0, 24, 24)
    errors = [flip(np.clip(image + shift, 0, 1), image) for shift in (0.0, 0.02, 0.1)]
    assert errors[0] == 0.0
    assert errors[0] < errors[1] < errors[2]  # type: ignore[operator]
    assert flip(np.zeros((24, 24, 3)), np.ones((24, 24, 3))) == pytest.approx(0.967, abs=0.005)


def test_flip_is_averaged_over_a_split() -> None:
    pytest.importorskip("flip_evaluator")
    distances = PerceptualDistances(Lpips(None, "not installed"), Flip.find())
    pairs = [Pair(f"v{i}", 0.0, noise(i, 16, 16), noise(9, 16, 16)) for i in range(2)]
    split = measure_split(pairs, distances)
    singles = [measure(pair, distances).flip_ldr for pair in pairs]
    assert split.flip_ldr == pytest.approx(np.mean([value for value in singles if value is not None]), rel=1e-12)
    assert split.flip_reason is None
