"""COLMAP folders that cannot be used: each is refused with file, field and what is wrong."""

from __future__ import annotations

import math
import struct
import sys
from pathlib import Path

import pytest

from graings.capture.load import load_capture
from graings.capture.readers.colmap_camera import CAMERA_MODELS, PANORAMIC_MODELS
from graings.config import CaptureConfig
from graings.errors import CaptureError
from tests.capture.captures import Break, cut, pixels, write_colmap, write_image


def patch(name: str, at: int, layout: str, *values: float) -> Break:
    """Overwrite numbers in a binary model file."""

    def apply(data: bytes) -> bytes:
        changed = bytearray(data)
        struct.pack_into(layout, changed, at, *values)
        return bytes(changed)

    return cut(name, apply)


CAMERAS, IMAGES, POINTS = (f"sparse/0/{name}.bin" for name in ("cameras", "images", "points3D"))
# cameras.bin: count, then id, model, width, height, fx, fy, cx, cy. images.bin: count, then id, quaternion, ...
BROKEN_COLMAP: dict[str, tuple[Break, str]] = {
    "missing image": (
        lambda f: [(f / f"images/frame_00{n}0.png").unlink() for n in (3, 4, 5)],
        r"sparse/0, image 'frame_0030\.png': .*is missing",
    ),
    "missing images.bin": (lambda f: (f / IMAGES).unlink(), rf"{IMAGES}: is missing"),
    "missing points": (lambda f: (f / POINTS).unlink(), rf"{POINTS}: is missing"),
    "truncated cameras.bin": (cut(CAMERAS, lambda d: d[:-1]), rf"{CAMERAS}: is truncated"),
    "truncated images.bin": (cut(IMAGES, lambda d: d[: len(d) // 2]), rf"{IMAGES}: is truncated"),
    "images.bin cut in a name": (cut(IMAGES, lambda d: d[: 8 + 64 + 5]), rf"{IMAGES}: is truncated"),
    "truncated points3D.bin": (cut(POINTS, lambda d: d[:-5]), rf"{POINTS}: is truncated"),
    "empty cameras.bin": (cut(CAMERAS, lambda d: b""), rf"{CAMERAS}: is truncated"),
    "bytes too many": (cut(CAMERAS, lambda d: d + b"\0\0"), rf"{CAMERAS}: 2 bytes too many"),
    "count that is too large": (patch(POINTS, 0, "<Q", 2**63), rf"{POINTS}: is truncated"),
    "no images": (cut(IMAGES, lambda d: struct.pack("<Q", 0)), r"sparse/0, images: the model has no registered image"),
    "unknown camera model": (patch(CAMERAS, 12, "<i", 77), rf"{CAMERAS}: camera 1 has the unknown model 77"),
    "negative focal length": (patch(CAMERAS, 32, "<d", -30.0), rf"{CAMERAS}: camera 1 needs .*positive focal"),
    "focal length is not finite": (patch(CAMERAS, 32, "<d", math.nan), rf"{CAMERAS}: camera 1 needs finite"),
    "camera without a size": (patch(CAMERAS, 16, "<Q", 0), rf"{CAMERAS}: camera 1 has the size 0x20"),
    "camera of another aspect ratio": (patch(CAMERAS, 16, "<Q", 50), r"sparse/0, cameras: the camera is for 50x20 px"),
    "missing camera": (patch(CAMERAS, 8, "<I", 5), r"sparse/0, cameras: the image .* refers to camera 1"),
    "zero rotation": (patch(IMAGES, 12, "<4d", 0, 0, 0, 0), rf"{IMAGES}, frame_0000\.png: the rotation is zero"),
    "pose is not finite": (patch(IMAGES, 44, "<d", math.inf), rf"{IMAGES}, frame_0000\.png: the pose is not finite"),
    "name leads outside": (
        cut(IMAGES, lambda d: d.replace(b"frame_0030.png", b"../../0030.png")),
        r"sparse/0, image '\.\./\.\./0030\.png': .*leads outside",
    ),
    "image listed twice": (
        cut(IMAGES, lambda d: d.replace(b"frame_0030.png", b"frame_0040.png")),
        r"sparse/0, images: the image frame_0040\.png is listed twice",
    ),
    "times without one image": (
        lambda f: (f / "times.json").write_text('{"frame_0000.png": 1}'),
        r"times\.json, frame_0010\.png: the time is missing",
    ),
    "times that are text": (
        lambda f: (f / "times.json").write_text('{"frame_0000.png": "NaN"}'),
        r"times\.json, frame_0000\.png: input should be a valid number",
    ),
    "unknown test image": (
        lambda f: (f / "sparse/0/test.txt").write_text("nobody.png\n"),
        r"sparse/0/test\.txt: 'nobody\.png' is no image of the model",
    ),
}


@pytest.mark.parametrize("name", BROKEN_COLMAP)
def test_broken_colmap_folder_is_refused_with_its_reason(tmp_path: Path, name: str) -> None:
    folder = write_colmap(tmp_path)
    load_capture(folder)  # valid before it is damaged
    breaks, message = BROKEN_COLMAP[name]
    breaks(folder)
    with pytest.raises(CaptureError, match=f"^{message}") as caught:
        load_capture(folder)
    assert caught.value.remedy


BROKEN_TEXT: dict[str, tuple[Break, str]] = {
    "cut in a camera": (
        cut("sparse/0/cameras.txt", lambda d: d[:-12]),
        r"sparse/0/cameras\.txt, line 4: .*4 parameters",
    ),
    "cut in a pose": (
        cut("sparse/0/images.txt", lambda d: d[: d.index(b"frame_0000") - 30]),
        r"sparse/0/images\.txt, line 5: is no image",
    ),
    "cut between images": (
        cut("sparse/0/images.txt", lambda d: b"\n".join(d.splitlines()[:10]) + b"\n"),
        r"sparse/0/images\.txt: declares 10 entries and contains 3",
    ),
    "cut between points": (
        cut("sparse/0/points3D.txt", lambda d: b"\n".join(d.splitlines()[:13]) + b"\n"),
        r"sparse/0/points3D\.txt: declares 40 entries and contains 10",
    ),
    "word for a number": (
        cut("sparse/0/cameras.txt", lambda d: d.replace(b"PINHOLE 32", b"PINHOLE wide")),
        r"sparse/0/cameras\.txt, line 4: is no camera",
    ),
}


@pytest.mark.parametrize("name", BROKEN_TEXT)
def test_broken_text_model_is_refused_with_its_reason(tmp_path: Path, name: str) -> None:
    folder = write_colmap(tmp_path, text=True)
    breaks, message = BROKEN_TEXT[name]
    breaks(folder)
    with pytest.raises(CaptureError, match=f"^{message}"):
        load_capture(folder)


@pytest.mark.parametrize("text", [False, True], ids=["binary", "text"])
def test_panoramas_are_refused_with_the_way_to_cut_them(tmp_path: Path, text: bool) -> None:
    where = rf"sparse/0/cameras\.{'txt, line 4' if text else 'bin, camera 1'}"
    write_colmap(tmp_path, model="EQUIRECTANGULAR", params=(64.0, 32.0), size=(64, 32), text=text)
    with pytest.raises(CaptureError, match=rf"^{where}: .*EQUIRECTANGULAR show all directions.*perspective views"):
        load_capture(tmp_path)


def test_every_model_of_colmap_is_read_or_explained() -> None:
    pycolmap = pytest.importorskip("pycolmap")
    known = {int(value): name for name, value in pycolmap.CameraModelId.__members__.items() if name != "INVALID"}
    assert {number: name for number, (name, _, _) in CAMERA_MODELS.items()} | PANORAMIC_MODELS == known


def test_lens_that_cannot_be_undistorted_is_refused(tmp_path: Path) -> None:
    write_colmap(tmp_path, model="SIMPLE_RADIAL", params=(30.0, 1e9, 10.0, 0.1))
    with pytest.raises(CaptureError, match=r"^sparse/0, cameras: the camera SIMPLE_RADIAL .* cannot be undistorted"):
        load_capture(tmp_path)


def test_focal_length_that_overflows_when_scaled_to_the_images_is_refused(tmp_path: Path) -> None:
    write_colmap(tmp_path, count=1, params=(1.5e308, 1.5e308, 15.5, 10.5))
    write_image(tmp_path / "images/frame_0000.png", pixels(40, 64, 3))
    with pytest.raises(CaptureError, match=r"^sparse/0, cameras: intrinsics must be finite"):
        load_capture(tmp_path)


def test_error_for_a_distorted_capture_without_pycolmap_names_the_extra(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_colmap(tmp_path, model="SIMPLE_RADIAL", params=(30.0, 16.0, 10.0, 0.05))
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    monkeypatch.setattr("platform.machine", lambda: "x86_64")
    with pytest.raises(CaptureError, match=r"pip install 'graings\[colmap\]'"):
        load_capture(tmp_path)
    monkeypatch.setattr("platform.machine", lambda: "aarch64")
    with pytest.raises(CaptureError, match="colmap image_undistorter") as caught:
        load_capture(tmp_path)
    assert "pycolmap has no build for Linux on aarch64" in caught.value.remedy
    assert "install" not in caught.value.remedy


def test_pinhole_capture_needs_no_pycolmap(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_colmap(tmp_path)
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    assert len(load_capture(tmp_path).train) == 7


def test_name_without_a_number_is_refused_with_times_from_names(tmp_path: Path) -> None:
    folder = write_colmap(tmp_path, text=True)
    (folder / "images/frame_0030.png").rename(folder / "images/face.png")
    path = folder / "sparse/0/images.txt"
    path.write_text(path.read_text().replace("frame_0030.png", "face.png"))
    with pytest.raises(CaptureError, match=r"^images/face\.png, name: the file name contains no number"):
        load_capture(folder, CaptureConfig(times_from_names=True))
