"""Captures at the edge of what can be trained: tiny and huge worlds, one frame, one camera, nothing to see."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
import torch

from graings.capture.synthetic import write_synthetic
from graings.config import make_config
from graings.errors import CaptureError
from graings.training.run import TrainingRun
from tests.capture.captures import entry, orbit, write_image, write_transforms
from tests.training.micro import finite, micro_config, micro_trainer, quality, steps

SIDE = 16


def _scaled(capture: Path, folder: Path, factor: float) -> Path:
    """The same capture in other units of length."""
    folder.mkdir()
    for split in ("train", "val", "test"):
        facts = json.loads((capture / f"transforms_{split}.json").read_text())
        for frame in facts["frames"]:
            for row in range(3):
                frame["transform_matrix"][row][3] *= factor
        (folder / f"transforms_{split}.json").write_text(json.dumps(facts))
        shutil.copytree(capture / split, folder / split)
    return folder


def _painted(
    folder: Path,
    paint: Callable[[int], Sequence[float]],
    *,
    frames: int = 6,
    cameras: int | None = None,
    times: int | None = None,
) -> Path:
    """Images of one colour each; `paint` gives that of frame i as RGB or RGBA in [0, 1]."""
    entries = []
    for index in range(frames):
        pixels = np.tile(np.rint(np.array(paint(index)) * 255).astype(np.uint8), (SIDE, SIDE, 1))
        write_image(folder / f"train/r_{index:03d}.png", pixels)
        camera = orbit(index % (cameras or frames), cameras or frames, (SIDE, SIDE))
        entries.append(entry(camera, f"./train/r_{index:03d}", (index % (times or frames)) / max(frames - 1, 1)))
    write_transforms(folder, "train", entries)
    write_transforms(folder, "val", [])
    return folder


@pytest.mark.slow(reason="four trainings of 300 steps; powers of two below need 30 to be exact")
@pytest.mark.parametrize("factor", [1e-4, 1e5])
def test_tiny_and_huge_scenes_train_as_well_as_others(micro: Path, tmp_path: Path, factor: float) -> None:
    """D09: 300 iterations; units of length are a power of two times normalised ones, so rounding differs."""
    qualities = []
    for capture in (micro, _scaled(micro, tmp_path / "scaled", factor)):
        trainer = micro_trainer(capture, iterations=300, **{"init.points": 400})
        assert trainer.step().gaussians > 0
        steps(trainer, 299)
        assert finite(trainer)
        qualities.append(quality(trainer))
    assert min(qualities) > 20
    assert abs(qualities[1] - qualities[0]) < 0.3


@pytest.mark.parametrize("exponent", [-13, 17])
def test_a_scene_scaled_by_a_power_of_two_trains_to_the_same_bits(micro: Path, tmp_path: Path, exponent: int) -> None:
    """D09, exact: between 1e-4 and 1e5 times the size."""
    trainers = [micro_trainer(c) for c in (micro, _scaled(micro, tmp_path / "scaled", 2.0**exponent))]
    reports = [steps(trainer, 30) for trainer in trainers]
    assert [report.loss for report in reports[0]] == [report.loss for report in reports[1]]
    one, other = (trainer.scene.state_dict() for trainer in trainers)
    assert all(torch.equal(one[name], other[name]) for name in one)


def test_one_frame_trains(tmp_path: Path) -> None:
    """D01: one image from one camera; no time, no parallax, no held-out view."""
    capture = write_synthetic(tmp_path / "one", seed=1, frames=1, size=SIDE, bodies=1)
    for split in ("val", "test"):
        (capture / f"transforms_{split}.json").unlink()
    run = TrainingRun.create(capture, tmp_path / "run", micro_config(iterations=100))
    reports = list(run)
    assert all(math.isfinite(report.loss) for report in reports)
    assert reports[-1].loss < 0.5 * reports[0].loss
    assert any("no_scale" in note or "no_parallax" in note for note in run.capture.notes)
    assert {report.phase for report in reports} == {"static"}
    document = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert (document["splits"], document["diverged"]) == ({}, False)


def test_one_camera_that_sees_many_times_trains(tmp_path: Path) -> None:
    """D02: eight images of one pose at eight times."""
    shades = [0.2 + 0.05 * index for index in range(8)]
    trainer = micro_trainer(
        _painted(tmp_path / "fixed", lambda i: (shades[i], 0.5, 0.5), frames=8, cameras=1), iterations=300
    )
    assert any("no_scale" in note for note in trainer.capture.notes)
    reports = steps(trainer, 150)
    assert {report.phase for report in reports} == {"warmup", "joint"}
    assert finite(trainer)
    assert sum(report.loss for report in reports[-8:]) < 0.5 * sum(report.loss for report in reports[:8])
    assert all(trainer.optimizer.rate(name, 1) > 0 for name in ("offsets", "features", "deformation"))


@pytest.mark.parametrize(("name", "color"), [("grey", (0.5,) * 3), ("black", (0.0,) * 3), ("white", (1.0,) * 3)])
def test_images_of_one_constant_colour_are_learned_and_hardly_grow(
    tmp_path: Path, name: str, color: tuple[float, ...]
) -> None:
    """D03: on a white background, so that white is empty space."""
    drafted = make_config("draft").density.model_dump()
    growing = {f"density.{name}": value for name, value in drafted.items()}
    trainer = micro_trainer(_painted(tmp_path / name, lambda _: color), iterations=300, **growing)
    start = trainer.scene.scaffold.count
    reports = steps(trainer, 150)
    assert finite(trainer)
    assert reports[-1].loss < 1e-2
    assert trainer.guard.rollbacks == 0
    assert trainer.scene.scaffold.count <= 1.1 * start


def test_alpha_that_is_zero_everywhere_is_refused(tmp_path: Path) -> None:
    """C08, all 0."""
    with pytest.raises(CaptureError, match="every mask is empty"):
        micro_trainer(_painted(tmp_path / "empty", lambda _: (0.3, 0.3, 0.3, 0.0)))


@pytest.mark.parametrize(
    ("name", "alpha"),
    [
        ("one empty frame", lambda i: 0.0 if i == 2 else 1.0),
        ("all opaque", lambda _: 1.0),
        ("half", lambda _: 0.5),
        ("absent", None),
    ],
)
def test_any_other_alpha_trains(tmp_path: Path, name: str, alpha: Callable[[int], float] | None) -> None:
    """C08 and D04: a frame with alpha 0, alpha 1, half and none at all."""
    colour = (0.3, 0.4, 0.5)
    capture = _painted(tmp_path / "c", lambda i: colour if alpha is None else (*colour, alpha(i)))
    trainer = micro_trainer(capture)
    assert trainer.capture.has_alpha is (alpha is not None)
    reports = steps(trainer, 60)
    assert finite(trainer)
    assert all(math.isfinite(report.loss) for report in reports)
    assert (trainer.guard.skipped, trainer.guard.rollbacks) == (0, 0)
