"""Videos: what is in them, and how an interrupted one goes on."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import av
import numpy as np
import OpenImageIO as oiio
import pytest

from graings.camera.camera import Camera
from graings.camera.view_request import ViewRequest
from graings.errors import CheckpointError
from graings.export import video_parts
from graings.export.camera_path import frames_of
from graings.export.video import FORMATS, check_video, video_size, write_video
from graings.export.video_file import CODECS, decoded, video_file
from graings.export.video_parts import open_parts
from graings.render import render
from tests.export.models import tiny_shown

WHITE = (1.0, 1.0, 1.0)
RED = np.broadcast_to(np.array([250, 0, 0], np.uint8), (48, 64, 3))
KINDS = (*FORMATS, "")

Frames = list[tuple[Camera, float]]


@pytest.fixture(autouse=True)
def parts_of_four_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(video_parts, "FRAMES", 4)


def path_of(count: int, width: int = 64) -> Frames:
    return frames_of(tiny_shown(), ViewRequest(width=width, height=48), "orbit", "both", count)


def length(path: Path) -> int:
    """Frames of a part."""
    return 4 if path.suffix else 1


def stopping_after(count: int) -> Callable[[int], None]:
    def observe(done: int) -> None:
        if done == count:
            raise KeyboardInterrupt

    return observe


def stop_after(count: int, path: Path, frames: Frames, **options: Any) -> None:
    with pytest.raises(KeyboardInterrupt):
        write_video(path, tiny_shown(), frames, WHITE, observe=stopping_after(count), **options)


def pictures(path: Path) -> list[np.ndarray]:
    """The frames of a video or of a folder of pictures."""
    if path.suffix == ".webp":
        file = oiio.ImageInput.open(str(path))
        count = path.read_bytes().count(b"ANMF")
        return [np.asarray(file.read_image(index, 0, 0, 3, "uint8")) for index in range(count)]
    if path.suffix:
        return list(decoded(path))
    return [np.asarray(oiio.ImageBuf(str(file)).get_pixels("uint8"))[..., :3] for file in sorted(path.iterdir())]


@pytest.mark.parametrize("fps", [20, 23.976])
@pytest.mark.parametrize(("suffix", "error"), [(".mp4", 6), (".webm", 8), (".webp", 6), (".gif", 12), ("", 0.51)])
def test_a_video_holds_the_rendered_frames_at_their_times(
    suffix: str, error: float, fps: float, tmp_path: Path
) -> None:
    scene, seen = tiny_shown(), []
    frames = path_of(10)
    path = tmp_path / f"a{suffix}"
    write_video(path, scene, frames, WHITE, fps=fps, observe=seen.append)
    assert seen == list(range(1, 11))
    found = pictures(path)
    assert len(found) == 10
    for (camera, time), pixels in zip(frames, found, strict=True):
        expected = 255 * render(scene.scene, camera, time, WHITE).color.clamp(0, 1).numpy()
        assert pixels.shape == (48, 64, 3)
        assert np.abs(pixels - expected).mean() < error
    assert [file.name for file in tmp_path.iterdir()] == [path.name]
    if suffix == ".webp":  # FFmpeg does not read animations of this format; a frame's duration is in its ANMF chunk
        chunks = [int.from_bytes(chunk[16:19], "little") for chunk in path.read_bytes().split(b"ANMF")[1:]]
        np.testing.assert_allclose(chunks, 1e3 / fps, atol=1.01)
    elif suffix:
        with av.open(str(path)) as container:
            times = [frame.time for frame in container.decode(video=0)]
        rounding = {".mp4": 1e-6, ".webm": 0.5e-3, ".gif": 10e-3}[suffix]
        np.testing.assert_allclose(times, np.arange(10) / fps, atol=1.01 * rounding)


def test_a_folder_of_pictures_has_a_file_for_each_frame(tmp_path: Path) -> None:
    write_video(tmp_path / "new" / "frames", tiny_shown(), path_of(3), WHITE)
    assert sorted(path.name for path in (tmp_path / "new" / "frames").iterdir()) == [f"0000{k}.png" for k in range(3)]


@pytest.mark.parametrize("suffix", [".webp", ".gif"])
def test_an_animated_picture_shows_no_trace_of_earlier_frames(suffix: str, tmp_path: Path) -> None:
    path, white = tmp_path / f"a{suffix}", np.full((48, 64, 3), 255, np.uint8)
    with video_file(path, 64, 48, 10.0) as add:
        for k in range(8):
            frame = white.copy()
            frame[12:36, 6 * k : 6 * k + 12] = 250 - 8 * k, 240, 250  # as faint as a soft edge
            add(frame)
        add(white)
    assert pictures(path)[-1].min() == 255


def test_odd_sides_lose_a_pixel_where_colour_is_subsampled(tmp_path: Path) -> None:
    frames = frames_of(tiny_shown(), ViewRequest(width=33, height=21), None, "time", 2)
    assert video_size(tmp_path / "a.mp4", frames[0][0]) == (32, 20)
    assert video_size(tmp_path / "a.gif", frames[0][0]) == (33, 21)
    write_video(tmp_path / "a.mp4", tiny_shown(), frames, WHITE)
    assert pictures(tmp_path / "a.mp4")[0].shape == (20, 32, 3)


@pytest.mark.parametrize("suffix", KINDS)
def test_an_interrupted_video_goes_on_after_its_last_part_and_is_the_same(suffix: str, tmp_path: Path) -> None:
    frames, seen = path_of(10), []
    path, whole = tmp_path / f"a{suffix}", tmp_path / f"whole{suffix}"
    write_video(whole, tiny_shown(), frames, WHITE)
    stop_after(6, path, frames)
    assert not path.exists()
    rendered = write_video(path, tiny_shown(), frames, WHITE, observe=seen.append)
    assert seen == (list(range(4, 11)) if suffix else list(range(1, 11)))
    assert rendered == (6 if suffix else 4)
    for found, expected in zip(pictures(path), pictures(whole), strict=True):
        np.testing.assert_array_equal(found, expected)
    assert sorted(file.name for file in tmp_path.iterdir()) == sorted([path.name, whole.name])


def test_an_mp4_has_the_same_bits_with_and_without_the_vector_code_of_its_encoder(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    frames = path_of(10)
    write_video(tmp_path / "vector.mp4", tiny_shown(), frames, WHITE)
    codec = CODECS[".mp4"]
    plain = {**codec.options, "x264-params": f"{codec.options.get('x264-params', '')}:asm=0".strip(":")}
    monkeypatch.setitem(CODECS, ".mp4", replace(codec, options=plain))
    write_video(tmp_path / "plain.mp4", tiny_shown(), frames, WHITE)
    for found, expected in zip(pictures(tmp_path / "vector.mp4"), pictures(tmp_path / "plain.mp4"), strict=True):
        np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("suffix", KINDS)
def test_what_is_there_is_not_rendered_again(suffix: str, tmp_path: Path) -> None:
    frames, path = path_of(7), tmp_path / f"a{suffix}"
    stop_after(5, path, frames)
    part = min(file for file in (tmp_path / f".a{suffix}.parts").iterdir() if file.name[0] == "0")
    with video_file(part, 64, 48, 30.0) as add:
        for _ in range(length(path)):
            add(RED)
    write_video(path, tiny_shown(), frames, WHITE)
    red = [bool(picture[..., 1:].max() < 20) for picture in pictures(path)]
    assert red == [True] * length(path) + [False] * (7 - length(path))


@pytest.mark.parametrize("suffix", KINDS)
@pytest.mark.parametrize("other", ["model", "path", "size", "background", "fps"])
def test_parts_of_another_video_are_not_used(suffix: str, other: str, tmp_path: Path) -> None:
    path = tmp_path / f"a{suffix}"
    stop_after(5, path, path_of(8))
    scene, frames, background, fps = tiny_shown(), path_of(8), WHITE, 30.0
    if other == "model":
        scene = tiny_shown(digest="another")
    elif other == "path":
        frames = path_of(9)
    elif other == "size":
        frames = path_of(8, width=32)
    elif other == "background":
        background = (0.0, 0.0, 0.0)
    else:
        fps = 25.0
    seen: list[int] = []
    write_video(path, scene, frames, background, fps=fps, observe=seen.append)
    assert seen == list(range(1, len(frames) + 1))
    if other == "background":
        assert all(picture[0, 0].max() < 30 for picture in pictures(path))


@pytest.mark.parametrize("suffix", KINDS)
def test_a_video_that_another_process_makes_is_left_alone(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"a{suffix}"
    with open_parts(path, "identity") as parts:
        with video_file(parts.file(0), 64, 48, 30.0) as add:
            add(RED)
        with pytest.raises(CheckpointError, match="made by another process"):
            write_video(path, tiny_shown(), path_of(3), WHITE)
        assert parts.file(0).exists()


@pytest.mark.parametrize("suffix", KINDS)
def test_a_video_that_stops_before_its_first_part_leaves_nothing(suffix: str, tmp_path: Path) -> None:
    frames = path_of(3)
    with pytest.raises(ValueError, match="background"):
        write_video(tmp_path / f"a{suffix}", tiny_shown(), frames, (0.0, 0.0))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("suffix", FORMATS)
def test_a_damaged_part_is_named_and_the_video_that_was_there_stays(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"a{suffix}"
    path.write_bytes(b"before")
    stop_after(5, path, path_of(7))
    part = min(file for file in (tmp_path / f".a{suffix}.parts").iterdir() if file.name[0] == "0")
    part.write_bytes(b"not a video")
    with pytest.raises(CheckpointError, match=rf"{re.escape(part.name)}: cannot be read .* Remove it"):
        write_video(path, tiny_shown(), path_of(7), WHITE)
    assert path.read_bytes() == b"before"
    part.unlink()
    write_video(path, tiny_shown(), path_of(7), WHITE)
    assert len(pictures(path)) == 7


def test_a_folder_that_holds_something_is_refused(tmp_path: Path) -> None:
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "00001.png").write_bytes(b"mine")
    with pytest.raises(CheckpointError, match="exists already"):
        write_video(tmp_path / "photos", tiny_shown(), path_of(3), WHITE)
    assert (tmp_path / "photos" / "00001.png").read_bytes() == b"mine"
    (tmp_path / "empty").mkdir()
    write_video(tmp_path / "empty", tiny_shown(), path_of(3), WHITE)
    assert len(pictures(tmp_path / "empty")) == 3


@pytest.mark.parametrize("suffix", KINDS)
def test_a_folder_in_place_of_a_file_and_the_reverse_are_refused_before_any_work(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"a{suffix}"
    if suffix:
        path.mkdir()
    else:
        path.write_bytes(b"mine")
    seen: list[int] = []
    with pytest.raises(CheckpointError, match="exists already"):
        write_video(path, tiny_shown(), path_of(3), WHITE, observe=seen.append)
    assert seen == []
    assert [file.name for file in tmp_path.iterdir()] == [path.name]


def test_wrong_requests_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"\.mp4, \.webm"):
        check_video(Path("a.avi"), 30.0)
    with pytest.raises(ValueError, match=r"\.mp4, \.webm"):
        check_video(Path("a.mkv"), 30.0)
    for fps in (0, 4e-4, 0.099, -1, math.nan, math.inf):  # a rate of 4e-4 would be rounded to none
        with pytest.raises(ValueError, match="fps"):
            write_video(tmp_path / "a.mp4", tiny_shown(), path_of(2), WHITE, fps=fps)


@pytest.mark.parametrize("fps", [100.01, 101.0, 240.0])
def test_a_rate_that_gif_does_not_have_is_refused_before_any_work(fps: float, tmp_path: Path) -> None:
    seen: list[int] = []
    with pytest.raises(ValueError, match=r"fps must lie in \[0\.1, 100\] for a \.gif file"):
        write_video(tmp_path / "a.gif", tiny_shown(), path_of(3), WHITE, fps=fps, observe=seen.append)
    assert seen == []
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("suffix", "fps"), [(".gif", 100.0), (".gif", 99.97), (".webp", 240.0), (".webm", 240.0)])
def test_the_highest_rate_of_a_format_is_written(suffix: str, fps: float, tmp_path: Path) -> None:
    path = tmp_path / f"a{suffix}"
    write_video(path, tiny_shown(), path_of(30), WHITE, fps=fps)
    assert len(pictures(path)) == 30
