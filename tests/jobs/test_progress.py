from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from graings.report.events import Grew
from jobs.progress import ProgressReport, ProgressWriter, last_progress, last_start, read_progress


def report(iteration: int, **changes: Any) -> ProgressReport:
    return ProgressReport(phase="joint", iteration=iteration, iterations=9_999, attempt=1, **changes)


def written(path: Path, *iterations: int) -> None:
    writer = ProgressWriter(path)
    for iteration in iterations:
        writer.write(report(iteration))
    writer.close()


def test_reading_goes_on_from_any_position_it_gave(tmp_path: Path) -> None:
    path = tmp_path / "progress.jsonl"
    written(path, 1, 2, 3)
    lines, end = read_progress(path, 0)
    assert [values.iteration for _, values in lines] == [1, 2, 3]
    after_first = lines[0][0]
    assert [values.iteration for _, values in read_progress(path, after_first)[0]] == [2, 3]
    assert read_progress(path, end) == ([], end)
    written(path, 4)
    assert [values.iteration for _, values in read_progress(path, end)[0]] == [4]


def test_a_position_inside_a_line_skips_the_rest_of_it(tmp_path: Path) -> None:
    path = tmp_path / "progress.jsonl"
    written(path, 1, 2)
    first_end = read_progress(path, 0)[0][0][0]
    assert [values.iteration for _, values in read_progress(path, first_end - 3)[0]] == [2]


def test_a_position_beyond_the_end_counts_as_the_end(tmp_path: Path) -> None:
    path = tmp_path / "progress.jsonl"
    written(path, 1)
    assert read_progress(path, 10_000) == ([], path.stat().st_size)


def test_an_unfinished_line_waits_for_its_end(tmp_path: Path) -> None:
    path = tmp_path / "progress.jsonl"
    written(path, 1)
    whole = path.stat().st_size
    with path.open("ab") as file:
        file.write(b'{"iteration"')
    assert read_progress(path, 0)[1] == whole
    assert last_progress(path) == report(1)


def test_a_line_torn_by_a_crash_spoils_no_other(tmp_path: Path) -> None:
    path = tmp_path / "progress.jsonl"
    written(path, 1)
    with path.open("ab") as file:
        file.write(b'{"iteration"')
    written(path, 2)
    assert [values.iteration for _, values in read_progress(path, 0)[0]] == [1, 2]


def test_numbers_that_json_does_not_have_become_null(tmp_path: Path) -> None:
    path = tmp_path / "progress.jsonl"
    writer = ProgressWriter(path)
    writer.write(report(3, loss=math.nan, psnr=math.inf))
    writer.close()
    assert last_progress(path) == report(3, loss=None, psnr=None)


def test_a_line_that_is_no_report_is_skipped(tmp_path: Path) -> None:
    path = tmp_path / "progress.jsonl"
    written(path, 1)
    with path.open("ab") as file:
        file.write(b'{"iteration": 2, "unknown": true}\n')
    assert last_progress(path) == report(1)


def test_events_come_back_with_their_message(tmp_path: Path) -> None:
    path = tmp_path / "progress.jsonl"
    writer = ProgressWriter(path)
    writer.write(report(5, events=(Grew(iteration=5, anchors=1_200),)))
    writer.close()
    assert b'"message":"grew 1,200 anchors"' in path.read_bytes()
    assert last_progress(path) == report(5, events=(Grew(iteration=5, anchors=1_200),))


def test_a_reader_can_start_at_the_newest_report(tmp_path: Path) -> None:
    path = tmp_path / "progress.jsonl"
    assert last_start(path) == 0
    for count in (1, 2, 2_000):
        path.unlink(missing_ok=True)
        written(path, *range(count))
        lines, _ = read_progress(path, last_start(path))
        assert [values.iteration for _, values in lines] == [count - 1]
