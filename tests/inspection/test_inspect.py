"""The inspection of whole captures: findings, text, picture."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

import graings
from graings.camera.camera import Camera
from graings.cli.main import app
from graings.config import CaptureConfig
from graings.inspection.document import Inspection
from graings.inspection.inspect import inspect_capture
from graings.kernel import usable_cores
from graings.plan.cost import CALIBRATION_FILE, Calibration, cache_folder
from graings.report.machine import machine_facts
from graings.storage.files import write_document
from tests.capture.captures import (
    entry,
    orbit,
    pixels,
    write_colmap,
    write_dnerf,
    write_image,
    write_single,
    write_transforms,
    write_walled,
)

MADE = Calibration(
    version=graings.__version__,
    cpu="x",
    threads=2,
    step=0.01,
    view=0.001,
    pixel=0.1,
    gaussian=0.1,
    gaussian_view=0.1,
    deformation=0.1,
    deformation_view=0.1,
    residual_view=0.1,
    float32=2.0,
    wall_over_cpu=0.6,
    error=0.1,
    cost_s=1.0,
)

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


def write_floor(folder: Path, count: int = 12) -> Path:
    """Views of a painted floor; every eighth is held out."""
    folder.mkdir(parents=True, exist_ok=True)
    cameras = [
        Camera.look_at((2.5 * np.cos(a), 2.5 * np.sin(a), 2.4), (0.1, 0, 0), fov=0.8, width=160, height=120)
        for a in np.linspace(0.0, 1.2, count)
    ]
    return write_walled(folder, cameras)


def change_poses(folder: Path, change: Any) -> None:
    for path in folder.glob("transforms_*.json"):
        document = json.loads(path.read_text())
        for frame in document["frames"]:
            frame["transform_matrix"] = change(np.array(frame["transform_matrix"])).tolist()
        path.write_text(json.dumps(document))


def findings(found: Inspection, about: str) -> list[str]:
    return [f"{finding.text}. {finding.remedy}" for finding in found.findings if finding.about == about]


def test_a_good_capture_is_described_without_a_finding(tmp_path: Path) -> None:
    found, picture = inspect_capture(write_floor(tmp_path), CaptureConfig(), picture=True)
    assert found.findings == ()
    assert (found.kind, found.images, found.source_size) == ("transforms", {"train": 11, "val": 1}, (160, 120))
    assert found.time_range == (0.0, 11 / 12)
    assert found.camera_distance[0] > 1
    assert found.consistency.share is not None
    assert found.consistency.share > 0.8
    assert Inspection.model_validate_json(found.model_dump_json(by_alias=True)) == found
    text = "\n".join(found.lines())
    assert "11 train, 1 val images" in text
    assert "SUSPICIOUS" not in text
    assert picture is not None
    assert picture.startswith(b"\x89PNG")


def test_a_camera_that_turns_on_the_spot_is_no_mistake_of_units(tmp_path: Path) -> None:
    cameras = [
        Camera.look_at((5, 6, 7), (5 + np.cos(a), 6 + np.sin(a), 7), fov=0.8, width=32, height=24)
        for a in np.linspace(0.0, 5.0, 12)
    ]
    for index in range(12):
        write_image(tmp_path / f"train/{index}.png", pixels(24, 32, seed=index))
    write_transforms(tmp_path, "train", [entry(camera, f"train/{index}") for index, camera in enumerate(cameras)])
    found, picture = inspect_capture(tmp_path)
    assert picture is None
    assert found.camera_distance == (0.0, 0.0, 0.0)
    assert [finding for finding in found.findings if finding.about == "units"] == []


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda m: m @ FLIP, "the camera axes are OpenCV's"),
        (np.linalg.inv, "the matrices are world-to-camera instead of camera-to-world"),
    ],
)
def test_wrong_axes_are_said_with_what_to_do(tmp_path: Path, change: Any, words: str) -> None:
    folder = write_floor(tmp_path)
    change_poses(folder, change)
    found, _ = inspect_capture(folder)
    (text,) = findings(found, "poses")
    assert words in text
    assert "Export the poses as the format asks for" in text
    assert any("SUSPICIOUS" in line and words in line for line in found.lines())


def test_a_capture_in_millimetres_is_said(tmp_path: Path) -> None:
    def enlarge(matrix: np.ndarray) -> np.ndarray:
        matrix[:3, 3] *= 1000
        return matrix

    folder = write_floor(tmp_path)
    change_poses(folder, enlarge)
    found, _ = inspect_capture(folder)
    assert found.consistency.share is not None
    assert found.consistency.share > 0.8
    assert "units from the centre" in findings(found, "units")[0]


def test_points_of_other_cameras_are_said(tmp_path: Path) -> None:
    folder = write_colmap(tmp_path, text=True)
    path = folder / "sparse/0/points3D.txt"
    moved = []
    for line in path.read_text().splitlines():
        words = line.split()
        if not line.startswith("#"):
            words[1:4] = [str(1000 + 50 * float(word)) for word in words[1:4]]
        moved.append(" ".join(words))
    path.write_text("\n".join(moved) + "\n")
    found, _ = inspect_capture(folder)
    assert "of the 40 points are in any picture" in findings(found, "points")[0]


def test_times_that_do_not_ascend_with_the_names_are_said(tmp_path: Path) -> None:
    assert not findings(inspect_capture(write_dnerf(tmp_path / "sorted", [i / 11 for i in range(12)]))[0], "times")
    times = np.random.default_rng(0).permutation(12) / 11
    found, _ = inspect_capture(write_dnerf(tmp_path / "shuffled", times.tolist()))
    assert "of the steps go back" in findings(found, "times")[0]


def test_a_gap_in_time_is_said(tmp_path: Path) -> None:
    found, _ = inspect_capture(write_dnerf(tmp_path, [0, 1, 2, 3, 4, 40, 41]))
    assert "a gap of 36 times the usual step follows the time 4" in findings(found, "times")[0]


@pytest.mark.parametrize("color", [(255, 255, 255), (90, 20, 200)])
def test_pictures_of_one_colour_are_said(tmp_path: Path, color: tuple[int, int, int]) -> None:
    folder = write_single(tmp_path, 10)
    for index in range(10):
        write_image(folder / f"images/frame_{index:05d}.png", np.full((40, 64, 3), color, np.uint8))
    found, _ = inspect_capture(folder)
    assert "show one colour and nothing else" in findings(found, "pictures")[0]


def test_masks_that_hide_nearly_everything_are_said(tmp_path: Path) -> None:
    folder = write_dnerf(tmp_path)
    valid = np.zeros((12, 12, 1), np.uint8)
    valid[:3, :3] = 255
    write_image(folder / "mask.png", valid)
    frames = [entry(orbit(i, 4), f"train/r_{i:03d}", mask_path="mask.png") for i in range(4)]
    write_transforms(folder, "train", frames)
    found, _ = inspect_capture(folder)
    assert found.masked == 4
    assert "the masks hide 94% of the pixels" in findings(found, "masks")[0]


def test_minutes_are_those_of_the_calibration_and_memory_grows_with_the_images(tmp_path: Path) -> None:
    small, _ = inspect_capture(write_floor(tmp_path / "small"), None, MADE)
    minutes = [small.forecasts[preset].minutes for preset in ("draft", "standard", "fine")]
    assert all(value is not None and value > 0 for value in minutes)
    assert minutes == sorted(minutes)  # type: ignore[type-var]
    assert "time unknown" in "\n".join(inspect_capture(write_floor(tmp_path / "other"))[0].lines())
    large, _ = inspect_capture(write_floor(tmp_path / "large", 40), None, MADE)
    assert large.forecasts["fine"].memory_mb > small.forecasts["fine"].memory_mb


def test_the_command_prints_the_text_or_the_document_and_writes_the_picture(tmp_path: Path) -> None:
    folder, picture = write_floor(tmp_path / "floor"), tmp_path / "cameras.png"
    run = CliRunner().invoke(app, ["inspect", str(folder), "-o", str(picture)])
    assert run.exit_code == 0, run.output
    assert "consistency  the poses explain" in run.output
    assert picture.read_bytes().startswith(b"\x89PNG")
    run = CliRunner().invoke(app, ["inspect", str(folder), "--json", "--set", "capture.max_side=80"])
    document = json.loads(run.output)
    assert document["schema"] == "graings.inspection/1"
    assert document["statistics"]["width"] == 80


def test_the_command_refuses_options_that_it_does_not_read(tmp_path: Path) -> None:
    folder = write_floor(tmp_path / "floor")
    run = CliRunner().invoke(app, ["inspect", str(folder), "--set", "iterations=50000"])
    assert run.exit_code == 2
    assert "graings plan" in run.output


@pytest.mark.parametrize("changed", [{"cpu": "of another machine"}, {"threads": 4_096}])
def test_the_command_predicts_no_minutes_from_measurements_of_another_machine(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, changed: dict[str, object]
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    cache_folder().mkdir(parents=True)
    here = {"cpu": machine_facts().cpu, "threads": usable_cores()}
    folder, minutes = write_floor(tmp_path / "floor"), []
    for facts in (here, {**here, **changed}):
        write_document(cache_folder() / CALIBRATION_FILE, MADE.model_copy(update=facts))
        run = CliRunner().invoke(app, ["inspect", str(folder), "--json"])
        minutes.append(json.loads(run.output)["forecasts"]["draft"]["minutes"])
    assert minutes[0] > 0
    assert minutes[1] is None
