from __future__ import annotations

from pathlib import Path

import pytest

from graings.footage.source import MIN_PHOTOGRAPHS, find_footage, video_suffix


def fill(folder: Path, *names: str) -> Path:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(b"x")
    return folder


def test_a_single_video_is_footage_wherever_it_lies(tmp_path: Path) -> None:
    assert find_footage(fill(tmp_path, "clips/a.MOV")) == tmp_path / "clips" / "a.MOV"


def test_photographs_of_one_folder_are_footage(tmp_path: Path) -> None:
    names = [f"photos/IMG_{index}.JPG" for index in range(MIN_PHOTOGRAPHS)]
    assert find_footage(fill(tmp_path, *names)) == tmp_path / "photos"


def test_hidden_files_and_folders_do_not_count(tmp_path: Path) -> None:
    names = [f"photos/{index}.jpg" for index in range(MIN_PHOTOGRAPHS)]
    hidden = ("photos/._0.jpg", ".thumbnails/0.jpg", "out/.footage/frames/00000.png", ".DS_Store")
    assert find_footage(fill(tmp_path, *names, *hidden)) == tmp_path / "photos"


@pytest.mark.parametrize(
    "names",
    [
        (),
        ("a.mp4", "b.mp4"),
        tuple(f"{index}.jpg" for index in range(MIN_PHOTOGRAPHS - 1)),
        (*(f"{index}.jpg" for index in range(MIN_PHOTOGRAPHS)), "transforms.json"),
        (*(f"{index}.jpg" for index in range(MIN_PHOTOGRAPHS)), "sparse/0/cameras.bin"),
        (*(f"cam{index % 2}/{index}.jpg" for index in range(MIN_PHOTOGRAPHS)),),
    ],
)
def test_anything_else_is_no_footage(tmp_path: Path, names: tuple[str, ...]) -> None:
    assert find_footage(fill(tmp_path, *names)) is None


@pytest.mark.parametrize(
    ("head", "suffix"),
    [
        (b"\0\0\0\x18ftypmp42", ".mp4"),
        (b"\x1a\x45\xdf\xa3" + bytes(8), ".mkv"),
        (b"RIFF\0\0\0\0AVI ", ".avi"),
        (b"RIFF\0\0\0\0WEBP", None),
        (b"PK\x03\x04", None),
        (b"", None),
    ],
)
def test_a_video_is_recognised_by_its_first_bytes(tmp_path: Path, head: bytes, suffix: str | None) -> None:
    (tmp_path / "file").write_bytes(head)
    assert video_suffix(tmp_path / "file") == suffix
