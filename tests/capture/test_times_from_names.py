"""Times that are taken from file names: which number of a name counts, and what is said where two could."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from graings.capture.capture import Capture
from graings.capture.load import load_capture
from graings.config import CaptureConfig
from graings.inspection.inspect import inspect_capture
from tests.capture.captures import entry, orbit, pixels, write_colmap, write_image, write_single, write_transforms

FROM_NAMES = CaptureConfig(times_from_names=True)
# Names in the order of their times, and these times but for unit and start.
CLEAR: dict[str, tuple[list[str], list[float]]] = {
    "frames": (["frame_9", "frame_10", "frame_00011"], [9, 10, 11]),
    "the last number": (["cam7_0001_left", "cam7_0002_left", "cam7_0004_left"], [1, 2, 4]),
    "seconds of a robot": (
        ["1305031102.300000", "1305031102.950000", "1305031103.000000", "1305031103.200000"],
        [0.3, 0.95, 1.0, 1.2],
    ),
    "fractions of any length": (["t_0.0625", "t_0.5", "t_0.75", "t_1.0"], [0.0625, 0.5, 0.75, 1.0]),
    "after t": (["view-t0.0625", "view-t0.5", "view-t1.0"], [0.0625, 0.5, 1.0]),
    "after time": (["Time9.5", "Time10.25", "Time10.5"], [9.5, 10.25, 10.5]),
    "frames of a shot": (["shot1.9", "shot1.10", "shot1.0011"], [9, 10, 11]),
    "a date": (["2024.01.05", "2024.01.06", "2024.01.10"], [5, 6, 10]),
}


def write_named(folder: Path, stems: list[str]) -> Path:
    """A capture in one transforms.json of images with these names, listed in another order."""
    frames = []
    for index, stem in enumerate(stems):
        write_image(folder / f"images/{stem}.png", pixels(12, 12, 3, seed=index))
        frames.append(entry(orbit(index, len(stems)), f"images/{stem}.png"))
    write_transforms(folder, "train", frames[::-1])
    write_transforms(folder, "val", [])
    return folder


def times_by_name(capture: Capture) -> dict[str, float]:
    return {Path(frame.name).stem: frame.time for _, frame in capture}


def points_notes(capture: Capture) -> list[str]:
    return [note for note in capture.notes if "the point" in note]


@pytest.mark.parametrize("name", CLEAR)
def test_times_ascend_with_the_numbers_that_the_names_mean(tmp_path: Path, name: str) -> None:
    stems, expected = CLEAR[name]
    found = times_by_name(load_capture(write_named(tmp_path, stems), FROM_NAMES))
    times = np.array([found[stem] for stem in stems])
    np.testing.assert_allclose(times, np.subtract(expected, expected[0]) / (expected[-1] - expected[0]), atol=1e-6)


def test_a_name_without_a_suffix_keeps_what_is_behind_the_point(tmp_path: Path) -> None:
    folder = write_colmap(tmp_path, count=4, text=True)
    file = folder / "sparse/0/images.txt"
    text = file.read_text()
    for index, time in enumerate(("0.5", "0.0625", "0.25", "0.75")):
        text = text.replace(f"frame_{10 * index:04d}.png", f"t_{time}")
        (folder / f"images/frame_{10 * index:04d}.png").rename(folder / f"images/t_{time}.png")
    file.write_text(text)
    found = [frame.time for _, frame in load_capture(folder, FROM_NAMES)]
    assert sorted(found) == [0.0, pytest.approx(3 / 11), pytest.approx(7 / 11), 1.0]


def test_a_point_that_can_be_read_in_two_ways_is_said_with_the_reading(tmp_path: Path) -> None:
    one = load_capture(write_named(tmp_path / "one", ["take_1.0001", "take_1.0002", "take_2.0001"]), FROM_NAMES)
    (note,) = points_notes(one)
    assert "images/take_2.0001.png is taken as 2.0001" in note  # the file lists it first
    other = load_capture(write_named(tmp_path / "other", ["shot1.0001", "shot1.0002", "shot2.0001"]), FROM_NAMES)
    (note,) = points_notes(other)
    assert "images/shot2.0001.png is taken as 1:" in note
    assert times_by_name(other) == {"shot1.0001": 0.0, "shot1.0002": 1.0, "shot2.0001": 0.0}
    found, _ = inspect_capture(tmp_path / "other", FROM_NAMES)
    assert any(line.startswith("note") and note in line for line in found.lines())


@pytest.mark.parametrize("stems", [["shot1.0001", "shot1.0002", "shot1.0004"], ["a_3", "a_4", "a_6"]])
def test_nothing_is_said_where_both_readings_give_the_same_times(tmp_path: Path, stems: list[str]) -> None:
    capture = load_capture(write_named(tmp_path, stems), FROM_NAMES)
    assert points_notes(capture) == []
    assert sorted(times_by_name(capture).values()) == [0.0, pytest.approx(1 / 3), 1.0]


def test_frames_of_a_rig_are_read_in_the_same_way(tmp_path: Path) -> None:
    folder = write_single(tmp_path, 3)
    for camera in range(3):
        for time in ("0.0625", "0.5", "1.0"):
            write_image(folder / f"frame_{camera:05d}/{time}.png", pixels(40, 64, 3))
    capture = load_capture(folder, CaptureConfig(rig=True))
    assert capture.times.tolist() == [0.0, pytest.approx(7 / 15), 1.0]
    assert len(points_notes(capture)) == 1


def test_decimal_numbers_that_ascend_with_the_times_are_not_suspicious(tmp_path: Path) -> None:
    times = [index / 16 for index in range(1, 17)]
    folder = write_named(tmp_path, [f"t_{time}" for time in times])
    file = folder / "transforms_train.json"
    document = json.loads(file.read_text())
    for frame in document["frames"]:
        frame["time"] = float(Path(frame["file_path"]).stem[2:])
    file.write_text(json.dumps(document))
    found, _ = inspect_capture(folder)
    assert [finding for finding in found.findings if finding.about == "times"] == []
