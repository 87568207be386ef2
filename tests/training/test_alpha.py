"""Training with the alpha loss: objects of the background colour become opaque."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from graings.capture.images import ImageStore
from graings.capture.load import load_capture
from graings.config import make_config
from graings.evaluation.evaluate import evaluate
from graings.plan.capture_statistics import measure
from graings.plan.plan import make_plan
from graings.render import render
from graings.training import losses
from tests.capture.captures import entry, orbit, write_image, write_transforms
from tests.training.micro import GROWING, micro_trainer, steps

SIDE = 16
BLACK = (0.0, 0.0, 0.0)


def snowman(folder: Path, *, alpha: bool = True) -> Path:
    """A square half of which is white, before a white background, seen from six sides."""
    pixels = np.zeros((SIDE, SIDE, 4), dtype=np.uint8)
    pixels[4:12, 4:12] = (255, 255, 255, 255)
    pixels[4:8, 4:12, :3] = (200, 40, 40)
    if not alpha:
        pixels = np.where(pixels[..., 3:] > 0, pixels[..., :3], 255).astype(np.uint8)
    entries = []
    for index in range(6):
        write_image(folder / f"train/r_{index:03d}.png", pixels)
        entries.append(entry(orbit(index, 6, (SIDE, SIDE)), f"./train/r_{index:03d}", index / 5))
    write_transforms(folder, "train", entries)
    write_transforms(folder, "val", [])
    return folder


def on_white_and_black(capture: Path, **options: object) -> tuple[float, float]:
    """PSNR on the white background of training, and on black."""
    trainer = micro_trainer(snowman(capture), iterations=300, **GROWING, **options)
    steps(trainer, 300)
    found = []
    for background in (trainer.background, BLACK):
        psnr = evaluate(trainer.scene, trainer.capture.train, ImageStore(background), background).psnr
        assert psnr is not None
        found.append(psnr)
    return found[0], found[1]


@pytest.mark.slow(reason="compares the quality of two trainings of 300 steps")
def test_a_white_object_on_white_is_opaque_on_black(tmp_path: Path) -> None:
    """With a weight that wins against the first colours, which are wrong: what they make faint nothing brings back."""
    white, black = on_white_and_black(tmp_path / "with", **{"loss.alpha": 3.0})
    white_without, black_without = on_white_and_black(tmp_path / "without", **{"loss.alpha": 0.0})
    assert white > 40 < white_without
    assert black > 30
    assert black_without < 10  # the white half is missing


def test_the_alpha_loss_changes_the_gradient_of_a_step(tmp_path: Path) -> None:
    capture = snowman(tmp_path / "c")
    without, weighed = (micro_trainer(capture, **{"loss.alpha": weight}) for weight in (0.0, 0.5))
    frame = weighed.capture.train[0]
    for trainer in (without, weighed):
        trainer.views.next = lambda iteration: [frame]  # type: ignore[method-assign]
    weighed.scene.temporal = False
    drawn = render(weighed.scene, frame.camera, frame.time, weighed.background)
    seen = weighed.images.alpha(frame)
    assert seen is not None
    expected = 0.5 * float(losses.alpha(drawn.alpha, torch.from_numpy(seen)))
    assert expected > 0.05
    assert steps(weighed, 1)[0].loss - steps(without, 1)[0].loss == pytest.approx(expected, rel=1e-5)


def test_a_capture_without_alpha_has_no_alpha_loss(tmp_path: Path) -> None:
    config = make_config("draft")
    for alpha, decision in ((True, "keep"), (False, "drop")):
        capture = load_capture(snowman(tmp_path / f"{alpha}", alpha=alpha), config.capture)
        plan = make_plan(measure(capture, ImageStore((1.0, 1.0, 1.0)), (1.0, 1.0, 1.0)), config)
        assert [d.decision for d in plan.decisions if d.component == "alpha_loss"] == [decision]
        assert plan.apply(config).loss.alpha == (config.loss.alpha if alpha else 0.0)
