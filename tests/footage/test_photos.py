from __future__ import annotations

from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest

from graings.errors import CaptureError
from graings.footage.photos import convert_photographs, photographs
from tests.footage.clips import read_png


def write(path: Path, pixels: np.ndarray, **attributes: object) -> None:
    image = oiio.ImageBuf(oiio.ImageSpec(pixels.shape[1], pixels.shape[0], 3, oiio.UINT8))
    for key, value in attributes.items():
        image.specmod().attribute(key.replace("__", ":"), value)
    image.set_pixels(oiio.ROI(), pixels.astype(np.float32) / 255)
    assert image.write(str(path)), image.geterror()


def convert(folder: Path, max_side: int = 64):  # type: ignore[no-untyped-def]
    target = folder / "out"
    target.mkdir()
    return convert_photographs(photographs(folder), target, max_side, lambda done, total: None)


def test_photographs_without_times_are_numbered_in_order_of_their_names(tmp_path: Path) -> None:
    for name in ("b.jpg", "a.png", "c.webp"):
        write(tmp_path / name, np.full((20, 30, 3), 90, np.uint8))
    (tmp_path / "notes.txt").write_text("no image")
    frames, notes = convert(tmp_path)
    assert [(frame.name, frame.time) for frame in frames] == [("00000.png", 0), ("00001.png", 1), ("00002.png", 2)]
    assert "order by name" in notes[0]


@pytest.mark.parametrize(
    "names",
    [
        [f"frame{index}.png" for index in range(1, 13)],
        [f"Frame{index}.png" if index % 2 else f"frame{index}.png" for index in range(1, 13)],
        ["2.png", "010.png", "11.png", "a1b9.png", "a1b10.png", "a2b1.png", "b.png", "b.webp"],
        ["IMG_9 (2).png", "IMG_10 (1).png", "IMG_10 (10).png"],
        ["9.jpg", "99999999999999999999999999999999999.jpg"],
    ],
)
def test_digits_of_a_name_count_as_a_number(tmp_path: Path, names: list[str]) -> None:
    for name in sorted(names, key=hash):
        (tmp_path / name).write_bytes(b"")
    assert [path.name for path in photographs(tmp_path)] == names


def test_hidden_files_are_no_photographs(tmp_path: Path) -> None:
    write(tmp_path / "a0.png", np.full((20, 30, 3), 90, np.uint8))
    (tmp_path / "._a0.png").write_bytes(b"\0\5\x16\7 Mac OS X")
    (tmp_path / ".trashed-1.jpg").write_bytes(b"")
    assert photographs(tmp_path) == [tmp_path / "a0.png"]


def test_times_of_the_exif_tags_order_the_frames(tmp_path: Path) -> None:
    for name, second in (("a.jpg", 30), ("b.jpg", 10), ("c.jpg", 20)):
        moment = f"2026:11:28 10:00:{second}"
        write(tmp_path / name, np.full((20, 30, 3), 90, np.uint8), Exif__DateTimeOriginal=moment)
    frames, notes = convert(tmp_path)
    assert [(frame.name, frame.time) for frame in frames] == [("00001.png", 0), ("00002.png", 10), ("00000.png", 20)]
    assert "EXIF" in notes[0]


@pytest.mark.parametrize("suffix", ["png", "tif", "jpg"])
def test_when_a_file_was_written_is_no_time_of_its_photograph(tmp_path: Path, suffix: str) -> None:
    for name, second in (("a", 30), ("b", 10), ("c", 20)):
        written = f"2026:11:28 10:00:{second}"
        write(tmp_path / f"{name}.{suffix}", np.full((20, 30, 3), 90, np.uint8), DateTime=written)
    frames, notes = convert(tmp_path)
    assert [(frame.name, frame.time) for frame in frames] == [("00000.png", 0), ("00001.png", 1), ("00002.png", 2)]
    assert "no times of their own" in notes[0]


@pytest.mark.parametrize("fraction", [{}, {"Exif__SubsecTimeOriginal": "00"}])
def test_a_burst_within_a_second_is_in_order_of_its_names(tmp_path: Path, fraction: dict[str, str]) -> None:
    for index in range(4):
        moment = f"2026:11:28 10:00:0{index // 2}"
        tags = {"Exif__DateTimeOriginal": moment, **fraction}
        write(tmp_path / f"{index}.jpg", np.full((20, 30, 3), 90, np.uint8), **tags)
    frames, notes = convert(tmp_path)
    assert [frame.time for frame in frames] == [0, 1, 2, 3]
    assert "no fractions of a second" in notes[0]


def test_fractions_of_a_second_count_and_two_cameras_may_see_the_same_moment(tmp_path: Path) -> None:
    for name, fraction in (("a1", "50"), ("a2", "25"), ("b1", "5"), ("b2", "25")):
        tags = {"Exif__DateTimeOriginal": "2026:11:28 10:00:00", "Exif__SubsecTimeOriginal": fraction}
        write(tmp_path / f"{name}.jpg", np.full((20, 30, 3), 90, np.uint8), **tags)
    frames, _ = convert(tmp_path)
    assert [(frame.name, frame.time) for frame in frames] == [
        ("00001.png", 0),
        ("00003.png", 0),
        ("00000.png", 0.25),
        ("00002.png", 0.25),
    ]


@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
def test_the_orientation_tag_is_applied(tmp_path: Path, orientation: int) -> None:
    upright = np.zeros((20, 30, 3), np.uint8)
    upright[:10, :15] = 255  # bright at the top left
    stored = np.rot90(upright, {1: 0, 3: 2, 6: 1, 8: 3}[orientation])
    write(tmp_path / "a.jpg", np.ascontiguousarray(stored), Orientation=orientation)
    convert(tmp_path)
    image = read_png(tmp_path / "out" / "00000.png")
    assert image.shape[:2] == (20, 30)
    assert image[:8, :12, :3].mean() > 0.9
    assert image[12:, 18:, :3].mean() < 0.1


def test_large_photographs_are_reduced(tmp_path: Path) -> None:
    write(tmp_path / "a.jpg", np.full((200, 100, 3), 60, np.uint8))
    convert(tmp_path, max_side=64)
    assert read_png(tmp_path / "out" / "00000.png").shape[:2] == (64, 32)


def test_a_photograph_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    (tmp_path / "broken.jpg").write_bytes(b"\xff\xd8\xff\xe0 not a photograph")
    with pytest.raises(CaptureError, match=r"broken\.jpg"):
        convert(tmp_path)
