from __future__ import annotations

import re
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from graings.errors import CaptureError
from graings.footage.sharpness import blurred, sharpness
from graings.footage.video import extract_frames
from tests.footage.clips import encode, read_png

pytest.importorskip("av")


def textured(seed: int, height: int = 48, width: int = 64) -> np.ndarray:
    coarse = np.random.default_rng(seed).integers(0, 256, (height // 8, width // 8, 3), dtype=np.uint8)
    return coarse.repeat(8, axis=0).repeat(8, axis=1)


def extract(video: Path, target: Path, count: int = 8, max_side: int = 64):  # type: ignore[no-untyped-def]
    target.mkdir(parents=True)
    return extract_frames(video, target, count, max_side, lambda done, total: None)


def test_frames_are_spread_over_the_whole_clip_with_their_presentation_times(tmp_path: Path) -> None:
    times = [index / 10 + (0.05 if index % 2 else 0.0) for index in range(40)]  # a variable frame rate
    video = encode(tmp_path / "a.mp4", (textured(index) for index in range(40)), times=times)
    seen, frames = extract(video, tmp_path / "out")
    assert (seen, len(frames)) == (40, 8)
    assert [frame.name for frame in frames] == [f"{index:05d}.png" for index in range(8)]
    assert all(min(abs(frame.time - time) for time in times) < 1e-3 for frame in frames)
    for index, frame in enumerate(frames):
        assert abs(frame.time - (index + 0.5) * 0.5) < 0.3


def test_the_sharpest_frame_of_an_interval_is_taken(tmp_path: Path) -> None:
    sharp = textured(0)
    smooth = np.full_like(sharp, 120)
    video = encode(tmp_path / "a.mp4", [sharp if index % 5 == 3 else smooth for index in range(40)])
    _, frames = extract(video, tmp_path / "out")
    assert [round(frame.time * 10) % 5 for frame in frames] == [3] * 8


def test_a_short_clip_gives_every_frame_once(tmp_path: Path) -> None:
    video = encode(tmp_path / "a.mp4", (textured(index) for index in range(5)))
    seen, frames = extract(video, tmp_path / "out", count=100)
    assert seen == len(frames) == 5


@pytest.mark.parametrize("count", [7, 32, 33])
def test_as_many_intervals_as_frames_give_each_frame_once(tmp_path: Path, count: int) -> None:
    video = encode(tmp_path / "a.mp4", (textured(index) for index in range(count)))
    _, frames = extract(video, tmp_path / "out", count=count)
    assert [round(frame.time * 10) for frame in frames] == list(range(count))


def test_large_frames_are_reduced_and_keep_their_aspect(tmp_path: Path) -> None:
    video = encode(tmp_path / "a.mp4", (textured(index, 96, 128) for index in range(8)))
    extract(video, tmp_path / "out", max_side=64)
    image = read_png(tmp_path / "out" / "00000.png")
    assert image.shape[:2] == (48, 64)


def test_the_rotation_that_phones_store_is_applied(tmp_path: Path) -> None:
    stored = np.zeros((48, 64, 3), np.uint8)
    stored[32:, :32] = 255  # at the bottom left; at the top left when turned clockwise
    extract(encode(tmp_path / "a.mp4", [stored] * 8, clockwise=True), tmp_path / "out")
    image = read_png(tmp_path / "out" / "00000.png")
    assert image.shape[:2] == (64, 48)
    assert image[:28, :12, :3].mean() > 0.9
    assert image[36:].mean() < 0.1


@pytest.mark.parametrize(
    ("aspect", "clockwise", "max_side", "size"),
    [
        (Fraction(4, 3), False, 200, (85, 48)),
        (Fraction(4, 3), False, 64, (64, 36)),
        (Fraction(3, 4), False, 200, (48, 48)),
        (Fraction(3, 4), True, 200, (48, 48)),
        (Fraction(4, 3), True, 64, (36, 64)),
        (Fraction(1, 1), False, 200, (64, 48)),
    ],
)
def test_pixels_that_are_not_square_become_square(
    tmp_path: Path, aspect: Fraction, clockwise: bool, max_side: int, size: tuple[int, int]
) -> None:
    stored = np.full((48, 64, 3), 20, np.uint8)
    stored[:, 32:] = 220
    video = encode(tmp_path / "a.mp4", [stored] * 8, pixel_aspect=aspect, clockwise=clockwise)
    extract(video, tmp_path / "out", max_side=max_side)
    image = read_png(tmp_path / "out" / "00000.png")[..., :3]
    assert image.shape[1::-1] == size
    along = image.mean(axis=(1, 2)) if clockwise else image.mean(axis=(0, 2))  # what is stored across
    half = len(along) // 2
    assert along[: half - 2].max() < 0.2
    assert along[half + 2 :].min() > 0.7


@pytest.mark.parametrize(("height", "matrix"), [(48, "ITU601"), (576, "ITU601"), (720, "ITU709"), (1080, "ITU709")])
def test_colours_survive_the_codec(tmp_path: Path, height: int, matrix: str) -> None:
    red = np.full((height, 64, 3), (200, 40, 30), np.uint8)
    extract(encode(tmp_path / "a.mp4", [red] * 8, matrix=matrix), tmp_path / "out")
    image = read_png(tmp_path / "out" / "00000.png")
    assert np.abs(image[..., :3] * 255 - red[0, 0]).max() < 6


@pytest.mark.parametrize(("transfer", "name"), [(16, "PQ"), (18, "HLG")])
def test_hdr_video_is_refused_with_the_remedy(tmp_path: Path, transfer: int, name: str) -> None:
    video = encode(tmp_path / "a.mp4", (textured(index) for index in range(8)), transfer=transfer)
    with pytest.raises(CaptureError, match=rf"HDR video \({name}\).*SDR"):
        extract(video, tmp_path / "out")


@pytest.mark.parametrize("content", [b"", b"not a video at all", b"\x00\x00\x00\x18ftypmp42"])
def test_what_is_no_video_is_named(tmp_path: Path, content: bytes) -> None:
    video = tmp_path / "broken.mp4"
    video.write_bytes(content)
    with pytest.raises(CaptureError, match=re.escape(str(video))):
        extract(video, tmp_path / "out")


def test_a_truncated_video_is_named(tmp_path: Path) -> None:
    whole = encode(tmp_path / "a.mp4", (textured(index) for index in range(20))).read_bytes()
    video = tmp_path / "half.mp4"
    video.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(CaptureError, match=r"half\.mp4"):
        extract(video, tmp_path / "out")


def test_a_frame_blurred_beside_its_neighbours_is_found() -> None:
    values = [5.0, 5.5, 5.2, 1.0, 5.1, 4.8, 5.0]
    assert blurred(values) == [False, False, False, True, False, False, False]
    assert blurred([3.0]) == [False]
    assert not any(blurred([5.0 * 0.9**index for index in range(30)]))  # a clip that slowly becomes softer


def test_sharpness_falls_with_blur_and_is_0_for_one_colour() -> None:
    image = np.random.default_rng(0).integers(0, 256, (40, 60), dtype=np.uint8)
    soft = ((image[:-1, :-1].astype(int) + image[1:, :-1] + image[:-1, 1:] + image[1:, 1:]) // 4).astype(np.uint8)
    assert sharpness(image) > 1.5 * sharpness(soft) > 0
    assert sharpness(np.full((40, 60), 7, np.uint8)) == 0
    assert sharpness(np.zeros((2, 2), np.uint8)) == 0
