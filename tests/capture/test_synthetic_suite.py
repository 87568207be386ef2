"""The suite of synthetic scenes: its captures load, its ground truth is true, and its bytes are the same everywhere."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest

from graings.capture.capture import Capture
from graings.capture.images import ImageStore
from graings.capture.load import load_capture
from graings.capture.synthetic import SUITE, synthesize
from graings.capture.synthetic.catalogue import scene_named
from graings.capture.synthetic.shapes import Room
from graings.capture.synthetic.world import World
from graings.capture.trajectories import read_trajectories
from graings.errors import CaptureError

SIZE, VIEWS, SEED = 32, 3, 3
NAMES = [scene.name for scene in SUITE]
NOTHING_MOVES = {"sundial", "dimmer", "still"}
ROOMS = {"crossing", "room"}


@pytest.fixture(scope="module")
def suite(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("suite")
    for name in NAMES:
        synthesize(name, folder / name, size=SIZE, views=VIEWS, seed=SEED)
    return folder


def world(name: str) -> World:
    return scene_named(name).build(SEED)


def document(folder: Path, split: str) -> dict[str, object]:
    loaded: dict[str, object] = json.loads((folder / f"transforms_{split}.json").read_text())
    return loaded


def times(folder: Path, split: str) -> list[float]:
    return [entry["time"] for entry in document(folder, split)["frames"]]  # type: ignore[attr-defined]


def digest(folder: Path) -> str:
    total = hashlib.sha256()
    for file in sorted(folder.rglob("*")):
        if file.is_file():
            total.update(f"{file.relative_to(folder)}\n".encode() + file.read_bytes())
    return total.hexdigest()


@pytest.mark.parametrize("name", NAMES)
def test_a_scene_loads_through_the_reader(suite: Path, name: str) -> None:
    capture: Capture = load_capture(suite / name)
    assert len(capture.train) == (24 if name == "rig" else VIEWS)
    assert len(capture.val) == 1
    assert len(capture.test) == 2
    assert len(capture.between) == (0 if name == "still" else 2)
    assert all(0.0 < frame.time < 1.0 for frame in capture.between)
    assert not {frame.time for frame in capture.between} & set(capture.times.tolist())
    assert capture.has_alpha == (name not in ROOMS)
    images = ImageStore((1.0, 1.0, 1.0), 16)
    for frame in capture.train[:2]:
        assert images.rgb(frame).shape == (SIZE, SIZE, 3)
        assert frame.camera.fx == pytest.approx(world(name).path.focal * SIZE)


@pytest.mark.parametrize("name", NAMES)
def test_every_scene_is_in_the_frame_and_well_lit(suite: Path, name: str) -> None:
    capture = load_capture(suite / name)
    images = ImageStore((1.0, 1.0, 1.0), 16)
    content = np.concatenate([images.rgb(frame).reshape(-1, 3) for frame in capture.train])
    if name not in ROOMS:
        content = content[content.min(axis=1) < 0.999]
    assert len(content) > 0.06 * len(capture.train) * SIZE * SIZE
    assert 0.25 < content.mean() < 0.8
    assert (content.max(axis=1) > 0.999).mean() < 0.15  # clipped


@pytest.mark.parametrize("name", NAMES)
def test_depth_lies_on_the_surface(suite: Path, name: str) -> None:
    entry = document(suite / name, "test")["frames"][1]  # type: ignore[index]
    pose, focal = np.array(entry["transform_matrix"]), world(name).path.focal
    depth = oiio.ImageInput.open(str(suite / name / "depth" / f"{entry['file_path'][2:]}.exr")).read_image("float")
    rows, columns = np.nonzero(depth[..., 0])
    z = depth[rows, columns, 0].astype(np.float64)
    x = ((columns + 0.5) / SIZE - 0.5) / focal * z
    y = ((rows + 0.5) / SIZE - 0.5) / focal * z
    points = pose[:3, :3] @ np.stack([x, -y, -z]) + pose[:3, 3:]
    gaps = [placed.distance(points) for placed in world(name).at(entry["time"]).parts]
    assert len(rows) > 30
    assert np.abs(np.min(gaps, axis=0)).max() < 3e-5


@pytest.mark.parametrize("name", NAMES)
def test_tracked_points_stay_on_their_surface(suite: Path, name: str) -> None:
    trajectories = read_trajectories(suite / name)
    assert trajectories is not None
    every = {time for split in ("train", "val", "test") for time in times(suite / name, split)}
    assert every <= set(trajectories.times)
    positions = trajectories.array()
    assert positions.shape == (len(trajectories.times), 200, 3)
    tracked = [part.moves for part in world(name).parts]
    if not any(tracked):
        tracked = [not isinstance(part.shape, Room) for part in world(name).parts]
        assert np.ptp(positions, axis=0).max() == 0.0
    else:
        assert name == "still" or np.ptp(positions, axis=0).max() > 0.1
    for time, points in zip(trajectories.times, positions, strict=True):
        parts = world(name).at(time).parts
        gaps = [placed.distance(points.T) for placed, of_interest in zip(parts, tracked, strict=True) if of_interest]
        assert np.abs(gaps).min(axis=0).max() < 3e-6  # rounded to six decimals


@pytest.mark.parametrize("name", NAMES)
def test_the_mask_shows_what_moves(suite: Path, name: str) -> None:
    share = np.mean(
        [
            oiio.ImageInput.open(str(file)).read_image("uint8").astype(float) / 255.0
            for file in sorted((suite / name / "moving" / "train").iterdir())
        ]
    )
    assert (share == 0.0) == (name in NOTHING_MOVES)
    if name == "room":
        assert share < 0.1


@pytest.mark.parametrize("name", [name for name in NAMES if name != "still"])
def test_times_between_lie_in_the_middle_of_training_times(suite: Path, name: str) -> None:
    trained = np.unique(times(suite / name, "train"))
    middles = 0.5 * (trained[1:] + trained[:-1])
    for time in times(suite / name, "between"):
        assert np.abs(middles - time).min() < 1e-12
    assert set(times(suite / name, "test")) <= set(trained.tolist())


def test_the_still_has_one_instant_and_no_times_between(suite: Path) -> None:
    assert set(times(suite / "still", "train")) == {0.0}
    assert not (suite / "still" / "transforms_between.json").exists()


def test_the_rig_sees_every_instant_from_twelve_cameras(suite: Path) -> None:
    frames = document(suite / "rig", "train")["frames"]
    seen: dict[str, list[float]] = {}
    for entry in frames:  # type: ignore[attr-defined]
        seen.setdefault(json.dumps(entry["transform_matrix"]), []).append(entry["time"])
    assert len(seen) == 12
    assert set(map(tuple, seen.values())) == {(0.0, 1.0)}


def test_the_same_seed_gives_the_same_bytes(suite: Path, tmp_path: Path) -> None:
    name = "chrome"
    again = synthesize(name, tmp_path / name, size=SIZE, views=VIEWS, seed=SEED)
    assert digest(again) == digest(suite / name)
    other = synthesize(name, tmp_path / f"{name}_other", size=SIZE, views=VIEWS, seed=SEED + 1)
    assert digest(other) != digest(suite / name)


PIXELS = """
import hashlib, sys
from graings.capture.synthetic.catalogue import SUITE
from graings.capture.synthetic.drawing import draw
from graings.capture.synthetic.planned_view import planned_views
from graings.capture.synthetic.tracking import track
total = hashlib.sha256()
for scene in SUITE:
    world = scene.build(0)
    for planned in planned_views(world, size=40, views=3, seed=0)["test"][1:]:
        view = draw(world, planned.viewpoint, 0.37 * planned.time + 0.11)
        for array in (view.rgba, view.depth, view.moving):
            total.update(array.tobytes())
        total.update(f"{planned} {planned.viewpoint.intrinsics()}".encode())
    total.update(track(world, 0, [0.0, 0.5, 1.0], 50).tobytes())
print(total.hexdigest())
"""


def pixels(**environment: str) -> str:
    """Hash of two views and the trajectories of every scene, drawn by another process."""
    variables = {**os.environ, **environment}
    ran = subprocess.run([sys.executable, "-c", PIXELS], env=variables, capture_output=True, text=True, check=True)
    return ran.stdout.strip()


@pytest.mark.slow  # draws every scene in several processes
def test_other_instruction_sets_draw_the_same_bits() -> None:
    from numpy._core._multiarray_umath import __cpu_dispatch__, __cpu_features__

    available = [feature for feature in __cpu_dispatch__ if __cpu_features__[feature]]
    if not available:
        pytest.skip("numpy has one instruction set on this machine")
    # From the newest to the oldest: with AVX-512 alone disabled, numpy runs AVX2; with both, SSE.
    variants = [{"NPY_DISABLE_CPU_FEATURES": " ".join(available[index:])} for index in range(len(available))]
    # The C library and the BLAS choose by the processor too.
    variants.append({"GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX2,-FMA", "OPENBLAS_CORETYPE": "Nehalem"})
    expected = pixels()
    assert [pixels(**variant) for variant in variants] == [expected] * len(variants)


@pytest.mark.slow  # each process imports its own libraries
def test_the_number_of_processes_changes_no_byte(suite: Path, tmp_path: Path) -> None:
    seen: list[tuple[int, int]] = []
    again = synthesize(
        "globe",
        tmp_path / "globe",
        size=SIZE,
        views=VIEWS,
        seed=SEED,
        processes=2,
        observe=lambda *done: seen.append(done),
    )
    assert digest(again) == digest(suite / "globe")
    assert seen == [(index, 8) for index in range(1, 9)]


def test_a_wrong_request_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no scene 'teapot'; there are walker"):
        synthesize("teapot", tmp_path / "x")
    with pytest.raises(ValueError, match="size and views"):
        synthesize("globe", tmp_path / "x", size=0)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "file").touch()
    with pytest.raises(CaptureError, match="not empty"):
        synthesize("globe", tmp_path / "full")


@pytest.mark.parametrize("processes", [1, 2])
def test_an_interrupted_scene_leaves_nothing(tmp_path: Path, processes: int) -> None:
    def interrupt(done: int, total: int) -> None:
        assert total > 3
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        synthesize("still", tmp_path / "still", size=16, views=20, processes=processes, observe=interrupt)
    assert list(tmp_path.iterdir()) == []
    synthesize("still", tmp_path / "still", size=16, views=1)  # the same folder can be used
