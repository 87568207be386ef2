"""The compact file of a model: smaller, the same images, and a clear error where a file is none."""

from __future__ import annotations

import gzip
import json
import shutil
from pathlib import Path

import pytest
import torch

from graings import constants
from graings.capture.synthetic import write_synthetic
from graings.config import make_config
from graings.errors import CheckpointError, OutputError
from graings.render import render
from graings.report.evaluate_run import evaluate_run
from graings.storage.checkpoint import load_model
from graings.storage.compact import can_be_seen, open_model, read_compact, write_compact
from graings.storage.model import scene_bytes
from graings.storage.run_folder import CHECKPOINTS, MODEL_FILE
from graings.training.run import TrainingRun
from tests.models import tiny_scene


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("compact")
    capture = write_synthetic(folder / "capture", seed=1, frames=10, size=32, bodies=2)
    options = {"iterations": 40, "init.points": 30_000, "init.voxel_size": 0.02, "scene.children": 4, "threads": 1}
    options |= {
        f"scene.{name}": 32 for name in ("head_width", "deform_width", "time_width", "static_width")
    }  # anchors are most of it, and stay most of it
    options["density.unseen_pixels"] = 0.0
    list(TrainingRun.create(capture, folder / "run", make_config("draft", options)))
    return folder / "run"


def test_a_compact_model_shows_the_same_pictures_in_fewer_bytes(run: Path, tmp_path: Path) -> None:
    """E20, compact."""
    model = load_model(run)
    size = write_compact(model, tmp_path / "scene.graings")
    assert size == (tmp_path / "scene.graings").stat().st_size
    assert size < 0.7 * scene_bytes(model.scene)  # half of what an anchor carries is halved
    small = open_model(tmp_path / "scene.graings")
    for view in model.views["val"]:
        expected = render(model.scene, view.camera, view.time, model.background).color
        found = render(small.scene, view.camera, view.time, small.background).color
        assert float((found - expected).abs().max()) <= 2 / 255


def test_a_run_without_checkpoints_is_opened_and_measured_by_its_compact_model(run: Path, tmp_path: Path) -> None:
    without = tmp_path / "run"
    shutil.copytree(run, without, ignore=shutil.ignore_patterns(CHECKPOINTS))
    assert open_model(without).digest == read_compact(run / MODEL_FILE).digest
    assert evaluate_run(without, "val").psnr == pytest.approx(evaluate_run(run, "val").psnr, abs=0.05)


def test_everything_beside_the_tensors_comes_back_as_it_was(run: Path, tmp_path: Path) -> None:
    model = load_model(run)
    write_compact(model, tmp_path / "scene.graings")
    small = read_compact(tmp_path / "scene.graings")
    assert (small.units, small.background, small.config) == (model.units, model.background, model.config)
    assert (small.iteration, small.finished) == (model.iteration, True)
    assert small.scene.temporal == model.scene.temporal
    assert [view.name for view in small.views["test"]] == [view.name for view in model.views["test"]]
    again = tmp_path / "again.graings"
    write_compact(small, again)
    assert again.read_bytes() == (tmp_path / "scene.graings").read_bytes()


def test_a_run_leaves_its_compact_model_with_its_size_and_quality(run: Path) -> None:
    metrics = TrainingRun.resume(run).metrics_path.read_text()
    assert '"compact"' in metrics
    document = json.loads(metrics)
    assert document["bytes"]["compact"] == (run / document["compact"]["file"]).stat().st_size
    assert document["compact"]["psnr"] == pytest.approx(document["splits"]["val"]["psnr"], abs=0.05)


@pytest.mark.parametrize("residual", [True, False])
@pytest.mark.parametrize("view", [True, False])
def test_only_anchors_that_nothing_can_show_are_left_out(residual: bool, view: bool) -> None:
    scene = tiny_scene(anchors=300, residual=residual, opacity_view=view)
    with torch.no_grad():
        scene.scaffold.opacity_offsets.copy_(torch.linspace(-1.5, 0.5, 300))
    kept = can_be_seen(scene, scene.scaffold.features, scene.scaffold.opacity_offsets)
    assert 0 < int(kept.sum()) < 300
    eyes = torch.randn(21, 3, generator=torch.Generator().manual_seed(0)) * 3
    for eye, time in zip(eyes.tolist(), torch.linspace(0, 1, 21).tolist(), strict=True):
        shown = scene.compose(eye, time).opacities.amax(-1) > constants.ALPHA_MIN
        assert not (shown & ~kept).any()


@pytest.mark.parametrize("huge", [3.0, 1e6])
def test_what_half_precision_cannot_hold_stays_as_it_is(run: Path, tmp_path: Path, huge: float) -> None:
    model = load_model(run)
    with torch.no_grad():
        model.scene.scaffold.opacity_offsets[0] = huge
    write_compact(model, tmp_path / "scene.graings")
    offsets = read_compact(tmp_path / "scene.graings").scene.scaffold.opacity_offsets.detach()
    assert float(offsets[0]) == huge


def test_a_model_of_which_nothing_shows_is_an_empty_picture(run: Path, tmp_path: Path) -> None:
    model = load_model(run)
    with torch.no_grad():
        model.scene.scaffold.opacity_offsets.fill_(-5.0)
    write_compact(model, tmp_path / "scene.graings")
    small, view = read_compact(tmp_path / "scene.graings"), model.views["val"][0]
    assert small.scene.scaffold.count == 0
    image = render(small.scene, view.camera, view.time, small.background).color
    assert torch.equal(image, torch.tensor(small.background).expand_as(image))


def test_a_folder_where_a_file_is_wanted_is_named(run: Path, tmp_path: Path) -> None:
    for folder in (tmp_path, Path(".")):
        with pytest.raises(OutputError, match="is a folder where a file is wanted"):
            write_compact(load_model(run), folder)


@pytest.mark.parametrize(
    "content",
    [b"", b"no gzip", gzip.compress(b"no tensors"), gzip.compress(b"\x02" + bytes(7) + b"{}")],
    ids=["empty", "no gzip", "no tensors", "no header"],
)
def test_a_file_that_is_no_model_is_named(tmp_path: Path, content: bytes) -> None:
    file = tmp_path / "scene.graings"
    file.write_bytes(content)
    with pytest.raises(CheckpointError, match=r"scene\.graings: no model, or a damaged one"):
        open_model(file)


def test_a_cut_off_file_is_named_and_a_full_disk_leaves_the_old_one(run: Path, tmp_path: Path) -> None:
    model = load_model(run)
    file = tmp_path / "scene.graings"
    write_compact(model, file)
    whole = file.read_bytes()
    file.write_bytes(whole[:-100])
    with pytest.raises(CheckpointError, match="damaged"):
        open_model(file)
    with pytest.raises(OutputError, match="there is no folder"):
        write_compact(model, tmp_path / "absent" / "scene.graings")
