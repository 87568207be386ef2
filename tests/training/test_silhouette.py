"""What masks tell that colours do not: that something of the background's colour is no hole."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from graings.capture.image_file import decode
from graings.capture.images import ImageStore
from graings.capture.load import load_capture
from graings.capture.synthetic import write_synthetic
from graings.config import make_config
from graings.render import render
from graings.training.silhouette import Silhouette, opaque_and_hidden
from tests.capture.captures import write_image
from tests.training.micro import GROWING, micro_trainer, said, steps

WHITE = (1.0, 1.0, 1.0)


def _whiten(capture: Path, part: float, side: float = -np.inf) -> Path:
    """Make the lowest `part` of what training images show, from beyond `side` on, as white as the background."""
    for frame in load_capture(capture).train:
        if frame.camera.center[0] < side:
            continue
        pixels = decode(frame.image_path, frame.name)
        shown = (pixels[..., 3] > 0).nonzero()[0]
        first = int(np.quantile(shown, 1 - part)) if part < 1 else 0
        pixels[first:, :, :3] = pixels[first:, :, 3:]
        write_image(frame.image_path, (255 * pixels).round().astype(np.uint8))
    return capture


@pytest.fixture
def shining(tmp_path: Path) -> Path:
    """From one side the lower third of the bodies is white, as a plate that mirrors a white sky."""
    return _whiten(write_synthetic(tmp_path / "c", seed=1, frames=48, size=40), 1 / 3, side=0.0)


def _silhouette(capture: Path, **options: object) -> Silhouette | None:
    config = make_config("draft", options)
    return Silhouette.of(load_capture(capture, config.capture), ImageStore(config.capture.background_rgb()), config)


def test_it_is_the_opacity_that_the_mask_wants_and_the_colour_leaves_open(shining: Path) -> None:
    found = _silhouette(shining, **{"loss.silhouette": 0.25})
    assert found is not None
    assert 0.1 < found.share < 0.3
    frame = next(frame for frame in load_capture(shining).train if frame.camera.center[0] > 0)
    opacity = torch.rand(40, 40, generator=torch.Generator().manual_seed(0), dtype=torch.float64, requires_grad=True)
    loss = found.loss(opacity, frame)
    loss.backward()
    images = ImageStore(WHITE)
    alpha, rgb = images.alpha(frame), images.rgb(frame)
    assert alpha is not None
    expected, gradient = 0.0, np.zeros((40, 40))
    for row, column in np.ndindex(40, 40):
        mask, drawn = float(alpha[row, column]), opacity[row, column].item()
        likeness = max(0.0, mask - max(abs(1.0 - float(channel)) for channel in rgb[row, column]))
        expected += 0.25 / 1_600 * likeness * max(0.0, mask - drawn)
        gradient[row, column] = -0.25 / 1_600 * likeness * (mask > drawn)
    assert expected > 0
    assert loss.item() == pytest.approx(expected, rel=1e-6)
    assert opacity.grad is not None
    assert np.abs(opacity.grad.numpy() - gradient).max() <= 1e-6 * np.abs(gradient).max()


def test_it_is_left_out_where_it_has_nothing_to_say_or_too_much(tmp_path: Path, shining: Path) -> None:
    plain = write_synthetic(tmp_path / "plain", seed=1, frames=6, size=40)
    assert _silhouette(plain) is None
    assert _silhouette(shining, **{"loss.silhouette": 0.0}) is None
    assert _silhouette(shining, **{"capture.background": "black"}) is None
    assert _silhouette(_whiten(plain, 0.9)) is None  # as a white floor on white
    for frame in load_capture(shining).train:
        image = decode(frame.image_path, frame.name)[..., :3]
        write_image(frame.image_path, (255 * image).round().astype(np.uint8))
    capture = load_capture(shining)
    assert Silhouette.of(replace(capture, has_alpha=True), ImageStore(WHITE), make_config("draft")) is None


def test_white_things_are_no_holes(shining: Path) -> None:
    opacities = []
    for options in ({}, {"loss.silhouette": 0.0}):
        trainer = micro_trainer(shining, iterations=600, **{"init.points": 5_000}, **GROWING, **options)
        reports = steps(trainer, 600)
        assert len(said(reports[:1], "silhouette: 16 %")) == (0 if options else 1)
        assert said(reports[1:], "silhouette") == []
        shown = []
        for frame in trainer.capture.train:
            hidden = opaque_and_hidden(frame, trainer.images, WHITE)[1]
            if not hidden.any():
                continue
            with torch.no_grad():
                drawn = render(trainer.scene, frame.camera, frame.time, WHITE)
            shown.append(float(drawn.alpha.numpy()[hidden].mean()))
        opacities.append(sum(shown) / len(shown))
    print(f"opacity of what looks like a hole: {opacities[0]:.3f}, without the term {opacities[1]:.3f}")
    assert opacities[0] > 0.9 > 0.8 > opacities[1]
