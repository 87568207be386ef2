"""The one colour around what opaque pictures show."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from graings.capture.background import border_color, with_background
from graings.capture.capture import Frame
from graings.capture.images import ImageStore
from graings.capture.load import load_capture
from graings.capture.synthetic import write_synthetic
from graings.config import CaptureConfig
from graings.errors import CaptureError
from graings.storage.compact import open_model, read_compact
from graings.training.run import TrainingRun
from tests.capture.captures import pixels, without_alpha, write_dnerf, write_image
from tests.training.micro import micro_config

AUTO = CaptureConfig()
GREY = (0.2, 0.4, 0.6)


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    """A ball or two on nothing, in transparent pictures."""
    return write_synthetic(tmp_path / "c", seed=1, frames=6, size=24)


def _bytes(frame: Frame) -> NDArray[np.uint8]:
    """The pixels [H, W, 3] of a frame on white."""
    return np.rint(255 * ImageStore((1.0, 1.0, 1.0)).rgb(frame)).astype(np.uint8)


def _background(folder: Path, config: CaptureConfig = AUTO) -> object:
    return with_background(config, load_capture(folder, config)).background


@pytest.mark.parametrize("colour", [(0.0, 0.0, 0.0), (1.0, 1.0, 1.0), GREY])
def test_it_is_what_surrounds_the_pictures(capture: Path, colour: tuple[float, float, float]) -> None:
    assert _background(without_alpha(capture, colour)) == ("white" if colour == (1.0, 1.0, 1.0) else colour)


def test_an_alpha_channel_that_is_opaque_everywhere_does_not_hide_it(capture: Path) -> None:
    without_alpha(capture, GREY)
    for _, frame in load_capture(capture):
        opaque = np.full((24, 24, 1), 255, np.uint8)
        write_image(frame.image_path, np.concatenate([_bytes(frame), opaque], axis=-1))
    assert load_capture(capture).has_alpha
    assert np.allclose(_background(capture), GREY, atol=1e-6)  # type: ignore[arg-type]


def test_noise_of_compression_does_not_hide_it(capture: Path) -> None:
    without_alpha(capture, GREY)
    noise = np.random.default_rng(0)
    for frame in load_capture(capture).train:
        seen = 255 * ImageStore((1.0, 1.0, 1.0)).rgb(frame) + noise.integers(-4, 5, (24, 24, 3))
        write_image(frame.image_path, np.rint(seen).clip(0, 255).astype(np.uint8))
    assert np.allclose(_background(capture), GREY, atol=1.5 / 255)  # type: ignore[arg-type]


def test_a_picture_of_all_sorts_has_none(tmp_path: Path) -> None:
    folder = write_dnerf(tmp_path / "c")
    for index in range(4):
        write_image(folder / f"train/r_{index:03d}.png", pixels(12, 12, 3, seed=index))
    assert border_color(load_capture(folder).train, ImageStore((1.0, 1.0, 1.0))) is None
    assert _background(folder) == "white"


def test_pictures_of_different_colours_have_none(capture: Path) -> None:
    without_alpha(capture, GREY)
    first = load_capture(capture).train[0].image_path
    write_image(first, np.zeros((24, 24, 3), np.uint8))
    assert _background(capture) == "white"


def test_a_thing_that_reaches_over_an_edge_does_not_hide_it(capture: Path) -> None:
    without_alpha(capture, GREY)
    frame = load_capture(capture).train[0]
    seen = ImageStore((1.0, 1.0, 1.0)).rgb(frame)
    seen[:, :4] = 0
    write_image(frame.image_path, np.rint(seen * 255).astype(np.uint8))
    assert np.allclose(_background(capture), GREY, atol=1e-6)  # type: ignore[arg-type]


@pytest.mark.parametrize("size", [(1, 1), (1, 5), (5, 1), (2, 2)])
def test_the_smallest_pictures_are_all_edge(tmp_path: Path, size: tuple[int, int]) -> None:
    folder = write_dnerf(tmp_path / "c")
    for index in range(4):
        write_image(folder / f"train/r_{index:03d}.png", np.full((*size, 3), 51, np.uint8))
    assert _background(folder) == (0.2, 0.2, 0.2)


def test_a_picture_that_cannot_be_read_is_named(capture: Path) -> None:
    data = load_capture(without_alpha(capture))
    path = data.train[0].image_path
    path.write_bytes(path.read_bytes()[:60])
    with pytest.raises(CaptureError, match=path.stem):
        with_background(AUTO, data)


def test_what_the_user_says_stands_and_alpha_means_white(capture: Path) -> None:
    assert _background(capture) == "white"
    black = CaptureConfig(background="black")
    assert _background(capture, black) == "black"
    without_alpha(capture, GREY)
    assert _background(capture, black) == "black"


def test_a_run_says_and_keeps_it(capture: Path, tmp_path: Path) -> None:
    without_alpha(capture, (0.0, 0.0, 0.0))
    config = micro_config(**{"iterations": 2})
    run = TrainingRun.create(capture, tmp_path / "run", config)
    first = next(iter(run))
    (event,) = (event for event in first.events if event.kind == "background")
    assert event.color == (0.0, 0.0, 0.0)
    assert event.message == "pixels of the colour #000000 count as background"
    run.save()
    assert open_model(tmp_path / "run").background == (0.0, 0.0, 0.0)
    again = TrainingRun.resume(tmp_path / "run")
    for _ in again:
        pass
    assert json.loads((tmp_path / "run" / "metrics.json").read_text())["capture"]["background"] == [0.0, 0.0, 0.0]
    assert read_compact(tmp_path / "run" / "model.graings").background == (0.0, 0.0, 0.0)
