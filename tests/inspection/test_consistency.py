"""Pictures and poses that fit, and each mistake in writing poses."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from graings.camera.camera import Camera
from graings.camera.units import Units
from graings.capture.capture import Frame
from graings.capture.images import ImageStore
from graings.capture.load import load_capture
from graings.inspection.consistency import MIN_MATCHES, Consistency, consistency
from tests.capture.captures import write_walled

Matrix = NDArray[np.float64]
WHITE = (1.0, 1.0, 1.0)
UNITS = Units((0.3, -2.0, 1.0), scale=0.5, time_start=0.0, time_span=1.0, up=(0.0, 0.0, 1.0))
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


@pytest.fixture(scope="module")
def frames(tmp_path_factory: pytest.TempPathFactory) -> tuple[Frame, ...]:
    """Views of a painted floor from above, along an arc, at different heights."""
    cameras = [
        Camera.look_at(
            (2.5 * np.cos(a), 2.5 * np.sin(a), 2.4 + 0.4 * np.sin(3 * a)), (0.1, 0, 0), fov=0.8, width=240, height=200
        )
        for a in np.linspace(0.0, 1.2, 12)
    ]
    folder = write_walled(tmp_path_factory.mktemp("floor"), cameras)
    return load_capture(folder).train


def wrong(frames: tuple[Frame, ...], change: Callable[[Matrix], Matrix]) -> list[Frame]:
    """The frames as read from a transforms file whose matrices (camera to world, OpenGL axes) were changed."""
    found = []
    for frame in frames:
        camera = frame.camera
        matrix = change(np.linalg.inv(UNITS.camera_back(camera)) @ FLIP)
        pose = UNITS.camera(np.linalg.inv(matrix @ FLIP))
        size = camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height
        found.append(replace(frame, camera=Camera(pose, *size)))
    return found


def judged(frames: tuple[Frame, ...] | list[Frame]) -> Consistency:
    return consistency(frames, ImageStore(WHITE), UNITS, opengl=True)


def test_right_poses_explain_the_matches(frames: tuple[Frame, ...]) -> None:
    found = judged(frames)
    assert found.matches > 100
    assert found.share is not None
    assert found.share > 0.8
    assert found.other is None


def mirrored(matrix: Matrix) -> Matrix:
    mirror = np.diag([1.0, 1.0, -1.0, 1.0])
    return mirror @ matrix @ np.diag([-1.0, 1.0, 1.0, 1.0])


def swapped_positions(matrix: Matrix) -> Matrix:
    changed = matrix.copy()
    changed[:3, 3] = matrix[[0, 2, 1], 3] * (1, -1, 1)
    return changed


MISTAKES: dict[str, tuple[Callable[[Matrix], Matrix], str]] = {
    "OpenCV axes": (lambda m: m @ FLIP, r"the camera axes are OpenCV's \(y down, z forward\) instead of OpenGL's"),
    "inverted": (np.linalg.inv, r"the matrices are world-to-camera instead of camera-to-world$"),
    "inverted with OpenCV axes": (
        lambda m: np.linalg.inv(m @ FLIP),
        r"the matrices are world-to-camera .* and the camera axes OpenCV's",
    ),
    "a quarter turn": (
        lambda m: m @ np.array([[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]]),
        r"the pictures are turned by (90|270) degrees",
    ),
    "a mirrored world": (mirrored, r"the pictures are mirrored against the poses, or the world is left-handed"),
    "axes in another order": (lambda m: m[:, [1, 2, 0, 3]], r"the camera axes are \("),
    "positions in other axes": (swapped_positions, r"the positions have the axes \("),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_in_the_axes_is_named(frames: tuple[Frame, ...], name: str) -> None:
    change, message = MISTAKES[name]
    found = judged(wrong(frames, change))
    assert found.share is not None
    assert found.share < 0.4
    assert found.other is not None, found
    assert re.match(message, found.other), found.other
    assert found.other_share is not None
    assert found.other_share > 0.8


def test_poses_of_other_pictures_are_not_explained_by_any_convention(frames: tuple[Frame, ...]) -> None:
    shuffled = np.random.default_rng(0).permutation(len(frames))
    found = judged([replace(frame, camera=frames[other].camera) for frame, other in zip(frames, shuffled, strict=True)])
    assert found.share is not None
    assert found.share < 0.4
    assert found.other is None


def test_pictures_without_features_are_not_judged(frames: tuple[Frame, ...], tmp_path: Path) -> None:
    flat = [replace(frame, mask_path=None, name=f"{index}") for index, frame in enumerate(frames)]

    class Blank(ImageStore):
        def rgb(self, frame: Frame) -> NDArray[np.float32]:
            return np.ones((frame.camera.height, frame.camera.width, 3), np.float32)

    found = consistency(flat, Blank(WHITE), UNITS, opengl=True)
    assert (found.share, found.other) == (None, None)
    assert found.matches < MIN_MATCHES
    assert "features match" in str(found.reason)


def test_without_pycolmap_the_reason_names_the_extra(
    frames: tuple[Frame, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    monkeypatch.setattr("platform.machine", lambda: "x86_64")
    assert "pip install 'graings[colmap]'" in str(judged(frames).reason)
    monkeypatch.setattr("platform.machine", lambda: "aarch64")
    assert "no build for Linux on aarch64" in str(judged(frames).reason)
