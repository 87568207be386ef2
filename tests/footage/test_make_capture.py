"""From a video file with known cameras to a capture: every camera is compared with the one that filmed."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from graings.capture.load import load_capture
from graings.capture.synthetic.viewpoint import Viewpoint
from graings.config import CaptureConfig
from graings.document import read_document
from graings.errors import CaptureError
from graings.footage.make_capture import WORKSPACE, make_capture
from graings.footage.poses import pairs
from graings.footage.report import REPORT_FILE, FootageReport, lines
from graings.image_encoding import encode_image
from tests.footage.clips import FPS, encode, film, read_png

pytest.importorskip("av")
pytest.importorskip("pycolmap")

FRAMES, SIZE = 32, 320


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Viewpoint]]:
    images, cameras = film("room", FRAMES, SIZE)
    return encode(tmp_path_factory.mktemp("clip") / "room.mp4", images), cameras


def true_poses(frames: list[dict], cameras: list[Viewpoint]) -> np.ndarray:
    return np.array([cameras[round(frame["time"] * FPS)].transform() for frame in frames])


def errors(found: np.ndarray, true: np.ndarray) -> tuple[float, float]:
    """Root mean square of the centres' distances over the path's length, and the largest angle between axes in degrees.

    After the similarity that fits best: rotation from all axes, scale and translation from the centres. The centres of
    an arc alone leave the rotation about its chord open.
    """
    u, _, v = np.linalg.svd(np.einsum("nij,nkj->ik", true[:, :3, :3], found[:, :3, :3]))
    rotation = u @ np.diag([1, 1, np.sign(np.linalg.det(u @ v))]) @ v
    a, b = found[:, :3, 3] @ rotation.T, true[:, :3, 3]
    a, b = a - a.mean(axis=0), b - b.mean(axis=0)
    scale = (a * b).sum() / (a * a).sum()
    path = np.linalg.norm(np.diff(b, axis=0), axis=1).sum()
    traces = np.einsum("ij,njk,nik->n", rotation, found[:, :3, :3], true[:, :3, :3])
    return float(np.sqrt(((scale * a - b) ** 2).sum(axis=1).mean()) / path), float(
        np.degrees(np.arccos(np.clip((traces.min() - 1) / 2, -1, 1)))
    )


@pytest.mark.slow("a scene is drawn 32 times at 320 px, and its cameras are found")
def test_a_video_gives_the_cameras_that_filmed_it(clip: tuple[Path, list[Viewpoint]], tmp_path: Path) -> None:
    video, cameras = clip
    phases = []
    report = make_capture(video, tmp_path / "c", frames=FRAMES, observe=lambda phase, done, total: phases.append(phase))
    assert report.registered == FRAMES
    assert list(dict.fromkeys(phases)) == ["frames", "features", "matching", "mapping", "undistortion"]
    frames = json.loads((tmp_path / "c" / "transforms.json").read_text())["frames"]
    found = np.array([frame["transform_matrix"] for frame in frames])
    distance, angle = errors(found, true_poses(frames, cameras))
    assert distance < 0.01
    assert angle < 0.5
    assert abs(frames[0]["fl_x"] / (0.8 * SIZE) - 1) < 0.05
    assert read_document(tmp_path / "c" / REPORT_FILE, FootageReport, "") == report
    assert f"{FRAMES} of {FRAMES} frames" in lines(report)[0]
    assert not (tmp_path / "c" / WORKSPACE).exists()

    capture = load_capture(tmp_path / "c", CaptureConfig())
    assert len(capture.times) == len(capture.train)
    assert capture.points is not None
    up = found[:, :3, 1].mean(axis=0)
    assert up[2] / np.linalg.norm(up) > 0.99  # +z is up, as for captures of nerfstudio

    with pytest.raises(CaptureError, match="holds a capture already"):
        make_capture(video, tmp_path / "c")


@pytest.mark.slow("cameras are found twice")
def test_an_interrupted_call_continues_where_it_was(clip: tuple[Path, list[Viewpoint]], tmp_path: Path) -> None:
    video, _ = clip

    def interrupt(phase: str, done: int, total: int) -> None:
        if phase == "matching":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        make_capture(video, tmp_path / "c", frames=FRAMES, observe=interrupt)
    frames = tmp_path / "c" / WORKSPACE / "frames"
    written = {path.name: path.stat().st_mtime_ns for path in frames.iterdir()}
    assert len(written) == FRAMES
    again = {}

    def look(phase: str, done: int, total: int) -> None:
        if phase == "matching" and not again:
            again.update({path.name: path.stat().st_mtime_ns for path in frames.iterdir()})

    assert make_capture(video, tmp_path / "c", frames=FRAMES, observe=look).registered == FRAMES
    assert again == written

    other = encode(tmp_path / "other.mp4", film("still", 8, 16)[0])
    (tmp_path / "d").mkdir()
    with pytest.raises(KeyboardInterrupt):
        make_capture(video, tmp_path / "d", frames=FRAMES, observe=interrupt)
    with pytest.raises(CaptureError, match=r"was begun with room\.mp4"):
        make_capture(other, tmp_path / "d")


@pytest.mark.slow("a scene is drawn 16 times at 320 px")
def test_a_camera_that_only_turns_is_refused_with_the_remedy(tmp_path: Path) -> None:
    images, _ = film("room", 16, SIZE, turning=True)
    with pytest.raises(CaptureError, match=r"(hardly moves|registered \d+ of 16|none of 16).*Record|Walk"):
        make_capture(encode(tmp_path / "a.mp4", images), tmp_path / "c", frames=16)


def test_frames_that_have_nothing_in_common_are_refused(tmp_path: Path) -> None:
    noise = [np.random.default_rng(seed).integers(0, 256, (64, 64, 3), dtype=np.uint8) for seed in range(10)]
    with pytest.raises(CaptureError, match=r"none of 10 frames could be registered.*overlap"):
        make_capture(encode(tmp_path / "a.mp4", noise), tmp_path / "c", frames=10)
    assert not (tmp_path / "c" / "transforms.json").exists()


def test_a_call_for_other_frames_begins_again_as_the_remedy_of_a_refusal_says(tmp_path: Path) -> None:
    noise = [np.random.default_rng(seed).integers(0, 256, (64, 64, 3), dtype=np.uint8) for seed in range(12)]
    video = encode(tmp_path / "a.mp4", noise)
    for count in (4, 12, 6):
        with pytest.raises(CaptureError, match=rf"none of {count} frames"):
            make_capture(video, tmp_path / "c", frames=count)
    with pytest.raises(CaptureError, match="none of 6 frames"):
        make_capture(video, tmp_path / "c", frames=6, max_side=32)
    first = read_png(tmp_path / "c" / WORKSPACE / "frames" / "00000.png")
    assert first.shape[:2] == (32, 32)
    encode(video, noise[:5])  # the same name with other content
    with pytest.raises(CaptureError, match="none of 5 frames"):
        make_capture(video, tmp_path / "c", frames=6, max_side=32)


def test_two_calls_at_once_for_one_folder_are_refused(tmp_path: Path) -> None:
    noise = [np.random.default_rng(seed).integers(0, 256, (64, 64, 3), dtype=np.uint8) for seed in range(8)]
    video = encode(tmp_path / "a.mp4", noise)
    refused = []

    def second(phase: str, done: int, total: int) -> None:
        with pytest.raises(CaptureError, match="written by another process"):
            make_capture(video, tmp_path / "c", frames=8)
        refused.append(phase)

    with pytest.raises(CaptureError, match="none of 8 frames"):
        make_capture(video, tmp_path / "c", frames=8, observe=second)
    assert "matching" in refused


def test_photographs_of_different_sharpness_are_all_taken(tmp_path: Path) -> None:
    folder = tmp_path / "photos"
    folder.mkdir()
    for index in range(9):
        image = np.full((64, 64, 3), 0.5, np.float32)
        if index != 4:
            image = np.random.default_rng(index).random((64, 64, 3), dtype=np.float32)
        (folder / f"{index}.png").write_bytes(encode_image(image))
    with pytest.raises(CaptureError, match="none of 9 frames"):
        make_capture(folder, tmp_path / "c")


def test_a_missing_source_and_an_empty_folder_are_named(tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match="does not exist"):
        make_capture(tmp_path / "none.mp4", tmp_path / "c")
    (tmp_path / "empty").mkdir()
    with pytest.raises(CaptureError, match="holds no photographs"):
        make_capture(tmp_path / "empty", tmp_path / "d")


def test_photographs_may_lie_one_folder_down(tmp_path: Path) -> None:
    inner = tmp_path / "clip" / "images"
    inner.mkdir(parents=True)
    for index in range(9):
        (inner / f"{index}.png").write_bytes(encode_image(np.full((64, 64, 3), 0.5, np.float32)))
    with pytest.raises(CaptureError, match="none of 9 frames") as caught:
        make_capture(tmp_path / "clip", tmp_path / "c")
    assert "images" in str(caught.value)


def test_near_frames_and_loops_are_matched_once() -> None:
    chosen = pairs(100)
    assert len(set(chosen)) == len(chosen)
    assert all(0 <= i < j < 100 for i, j in chosen)
    assert {(0, 1), (0, 5), (0, 32), (0, 96), (94, 99)} <= set(chosen)
    assert len(chosen) < 1_000
    assert pairs(1) == []
