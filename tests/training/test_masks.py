"""Masked pixels take part in nothing: two captures that differ only there give the same model and the same metrics."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from graings.evaluation.evaluate import evaluate
from graings.report.folder import report_runs
from graings.report.metrics_document import read_metrics
from graings.training.run import TrainingRun
from graings.training.trainer import Trainer
from tests.capture.captures import entry, orbit, write_image, write_transforms
from tests.training.micro import GROWING, micro_config, micro_trainer, steps

COUNT, SIZE, STEPS = 9, 32, 60


def write_masked(folder: Path, occluder: int | None, *, masks: bool = True, alpha: bool = True) -> Path:
    """A ball on a transparent or white ground; `occluder` seeds noise over the left 12 columns of each image."""
    v, u = np.mgrid[:SIZE, :SIZE]
    inside = (u - 15.5) ** 2 + (v - 15.5) ** 2 < 64
    frames: dict[str, list[dict[str, object]]] = {"train": [], "val": []}
    for index in range(COUNT):
        image = np.full((SIZE, SIZE, 4), 255, np.uint8)
        image[..., 3] = 255 * inside if alpha else 255
        image[inside, :3] = (200, 20 * index, 40)
        if occluder is not None:
            image[:, :12] = np.random.default_rng((occluder, index)).integers(0, 256, (SIZE, 12, 4))
        write_image(folder / f"images/{index}.png", image if alpha else image[..., :3])
        valid = np.full((SIZE, SIZE, 1), 255, np.uint8)
        valid[:, :12] = 0 if occluder is not None else 255
        write_image(folder / f"masks/{index}.png", valid)
        keys = {"mask_path": f"masks/{index}.png"} if masks else {}
        camera = orbit(index, COUNT, (SIZE, SIZE))
        frames["val" if index == 4 else "train"].append(entry(camera, f"images/{index}", index / COUNT, **keys))
    for split, entries in frames.items():
        write_transforms(folder, split, entries)
    return folder


def trained(folder: Path) -> Trainer:
    trainer = micro_trainer(folder, **GROWING, **{"init.points": 4_000})
    steps(trainer, STEPS)
    return trainer


@pytest.mark.parametrize("alpha", [True, False])
def test_what_a_mask_hides_changes_no_bit_of_the_model_and_no_metric(tmp_path: Path, alpha: bool) -> None:
    results = []
    for seed in (1, 2):
        trainer = trained(write_masked(tmp_path / str(seed), seed, alpha=alpha))
        metrics = evaluate(trainer.scene, trainer.capture.val, trainer.images, (1.0, 1.0, 1.0))
        results.append((trainer.scene.state_dict(), metrics, trainer.density.statistics.state()))
    (first, metrics, observed), (second, others, observed_too) = results
    assert first.keys() == second.keys()
    for name in first:
        assert torch.equal(first[name], second[name]), name
    for name in observed:
        assert torch.equal(observed[name], observed_too[name]), name
    assert metrics == others
    assert metrics.views[0].compared == pytest.approx(20 / 32)


def test_without_the_mask_the_same_pixels_do_change_the_model(tmp_path: Path) -> None:
    scenes = [trained(write_masked(tmp_path / str(seed), seed, masks=False)).scene.state_dict() for seed in (1, 2)]
    assert any(not torch.equal(scenes[0][name], scenes[1][name]) for name in scenes[0])


def test_masks_that_hide_nothing_give_the_bits_of_training_without_them(tmp_path: Path) -> None:
    masked = trained(write_masked(tmp_path / "masks", None)).scene.state_dict()
    plain = trained(write_masked(tmp_path / "plain", None, masks=False)).scene.state_dict()
    for name in plain:
        assert torch.equal(masked[name], plain[name]), name


def test_an_image_that_is_masked_everywhere_is_trained_on_without_effect(tmp_path: Path) -> None:
    folder = write_masked(tmp_path, 1)
    write_image(folder / "masks/0.png", np.zeros((SIZE, SIZE, 1), np.uint8))
    write_image(folder / "masks/4.png", np.zeros((SIZE, SIZE, 1), np.uint8))
    trainer = micro_trainer(folder)
    assert all(np.isfinite(step.loss) for step in steps(trainer, 20))
    assert evaluate(trainer.scene, trainer.capture.val, trainer.images, (1.0, 1.0, 1.0)).psnr is None
    json.dumps(evaluate(trainer.scene, trainer.capture.val, trainer.images, (1.0, 1.0, 1.0)).to_json(), allow_nan=False)


def test_a_run_whose_only_validation_view_is_masked_everywhere_ends_and_gives_the_reason(tmp_path: Path) -> None:
    capture = write_masked(tmp_path / "capture", 1)
    write_image(capture / "masks/4.png", np.zeros((SIZE, SIZE, 1), np.uint8))
    run = TrainingRun.create(capture, tmp_path / "run", micro_config(iterations=12))
    assert [report.evaluation for report in run] == [None] * 12
    metrics = read_metrics(run.metrics_path)
    assert metrics.curve == ()
    assert (metrics.splits["val"].psnr, metrics.splits["val"].views) == (None, ())
    assert metrics.splits["val"].reason == "masks hide all pixels of the split's images"
    report_runs([run.folder], tmp_path / "report", render=False)
    resumed = list(TrainingRun.resume(run.folder))
    assert [report.iteration for report in resumed] == [12]
