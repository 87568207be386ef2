from __future__ import annotations

import csv
import io
import json
import math
from pathlib import Path
from typing import Any

import pytest

from graings.config import make_config
from graings.errors import CheckpointError
from graings.report.metrics_document import EvaluationPoint
from graings.report.tables import tables
from graings.report.work_precision import (
    TOLERANCE,
    pareto,
    phase_times,
    read_run,
    run_names,
    summary,
    time_to_psnr,
    training_part,
)
from graings.report.work_precision_document import TrainingPart, WorkPrecision
from graings.training.timing import Clock
from tests.report.reports import metrics, part, point, values, write_run


def line(*seconds: float) -> list[EvaluationPoint]:
    """A run that gains 10 dB with every ten times the seconds, and grows with them."""
    made = []
    for t in seconds:
        size = round(1000 * math.sqrt(t))
        made.append(point(t, 20 + 10 * math.log10(t), iteration=round(10 * t), gaussians=size))
    return made


def report(*parts: TrainingPart) -> WorkPrecision:
    return WorkPrecision(training=parts, render=(), omissions=("b: not rendered",))


def test_a_target_between_two_evaluations_is_found_on_the_line_through_them() -> None:
    (found,) = time_to_psnr(line(1, 100), [30.0])
    assert found.train_s == pytest.approx(10.0, rel=1e-12)
    assert (found.iteration, found.gaussians) == (100, 3162)


def test_a_target_that_an_evaluation_hits_is_its_own_time() -> None:
    (found,) = time_to_psnr(line(1, 10, 100), [30.0])
    assert found.train_s == pytest.approx(10.0, rel=1e-12)


def test_the_first_crossing_counts_also_when_quality_drops_again() -> None:
    curve = [point(1, 20.0), point(10, 30.0), point(20, 24.0), point(100, 32.0)]
    (found,) = time_to_psnr(curve, [25.0])
    assert found.train_s == pytest.approx(math.sqrt(10), rel=1e-12)


def test_what_was_not_reached_is_null_with_the_time_it_was_not_reached_in() -> None:
    (found,) = time_to_psnr(line(1, 10), [35.0])
    assert (found.train_s, found.iteration, found.gaussians) == (None, None, None)
    assert found.censored_at_s == 10
    assert found.reason is not None
    assert "30.00 dB" in found.reason


def test_what_the_first_evaluation_had_already_is_not_extrapolated() -> None:
    (found,) = time_to_psnr(line(3, 10), [20.0])
    assert (found.train_s, found.at_most_s) == (None, 3)
    assert found.reason is not None
    assert "first evaluation" in found.reason


def test_without_an_evaluation_every_target_has_that_reason() -> None:
    assert [entry.reason for entry in time_to_psnr([], [25.0, 30.0])] == ["no held-out view was evaluated"] * 2


def test_phases_within_the_tolerance_are_consistent() -> None:
    spent = phase_times(metrics(wall_s=100 / (1 - 0.9 * TOLERANCE)))
    assert spent.consistent
    assert spent.problems == ()
    assert spent.unaccounted_share == pytest.approx(0.9 * TOLERANCE)


@pytest.mark.parametrize("wall_s", [100 / (1 - 1.1 * TOLERANCE), 97.0])
def test_phases_that_miss_the_wall_clock_are_flagged_and_still_listed(wall_s: float) -> None:
    spent = phase_times(metrics(wall_s=wall_s))
    assert not spent.consistent
    assert "phases sum to 100 s" in spent.problems[0]
    assert spent.seconds == metrics().phases_s


def test_a_training_time_with_evaluation_in_it_is_flagged() -> None:
    assert "train_s is 92 s" in phase_times(metrics(train_s=92.0)).problems[0]


def test_the_wall_clock_includes_time_of_no_phase(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("time.perf_counter", lambda: 53.0)
    clock = Clock({"joint": 4.0}, 5.0, _started=50.0)
    clock.add("evaluation", 2.0)
    assert (clock.wall_s(), clock.total_s(), clock.train_s()) == (8.0, 6.0, 4.0)


def test_evaluation_and_checkpoints_stand_beside_the_training_time() -> None:
    totals = part("run", point(1, 25.0)).totals
    assert (totals.train_s, totals.evaluation_s, totals.checkpoint_s) == (80.0, 12.0, 7.0)


@pytest.mark.parametrize(("wanted", "status"), [(400, "finished"), (401, "unfinished")])
def test_a_run_that_was_cut_off_is_a_part_with_its_status(wanted: int, status: str) -> None:
    made = training_part("run", metrics(point(1, 25.0)), make_config("draft", {"iterations": wanted}))
    assert (made.run.status, made.run.preset) == (status, "draft")


def test_a_restarted_run_is_finished_after_all_its_iterations() -> None:
    """The configuration counts the iterations of one start; the metrics count those before the restart too."""
    restart = {"iteration": 100, "kind": "restart", "missing_share": 0.5, "time_window": 0.25}
    config = make_config("draft", {"iterations": 400})
    halfway, ended = (training_part("run", metrics(events=[restart], iterations=n), config).run for n in (400, 500))
    assert (halfway.status, halfway.iterations_wanted) == ("unfinished", 500)
    assert (ended.status, ended.iterations_wanted) == ("finished", 500)


def test_cpu_time_is_reported_beside_the_training_time() -> None:
    known = part("run", point(1, 25.0), train_cpu_s=150.0)
    assert known.totals.train_cpu_s == 150.0
    assert "after 1 s of training (2.5 min CPU time)" in summary(known)


def test_the_clock_adds_the_cpu_time_of_all_phases() -> None:
    clock = Clock()
    clock.add("joint", 1.0, 1.5)
    clock.add("joint", 1.0, 2.0)
    assert clock.train_cpu_s == 3.5


def test_the_document_is_strict_json_of_its_schema() -> None:
    made = report(part("a", *line(1, 100)), part("b"))
    values = json.loads(json.dumps(made.to_json(), allow_nan=False))
    assert values["schema"] == "graings.work_precision/1"
    assert [part["kind"] for part in values["training"]] == ["training", "training"]
    assert WorkPrecision.model_validate(values) == made


def test_the_front_is_what_nothing_beats() -> None:
    costs = [1.0, 2.0, 3.0, 2.0, 4.0, 0.5]
    errors = [9.0, 4.0, 5.0, 3.0, 1.0, 9.0]
    assert pareto(costs, errors) == [5, 3, 4]
    assert pareto([], []) == []


def rows(text: str) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(text)))


def test_the_tables_hold_every_point_of_every_run() -> None:
    made = tables(report(part("a, 1", *line(1, 10)), part("b", *line(1, 10, 100))))
    assert set(made) == {"points.csv", "time_to_psnr.csv", "phases.csv"}
    points = rows(made["points.csv"])
    assert [row["run"] for row in points] == ["a, 1"] * 2 + ["b"] * 3
    assert float(points[-1]["psnr"]) == pytest.approx(40.0)
    times = {(row["run"], row["target_db"]): row for row in rows(made["time_to_psnr.csv"])}
    assert float(times["b", "30.0"]["train_s"]) == pytest.approx(10.0)
    assert (times["a, 1", "35.0"]["train_s"], times["a, 1", "35.0"]["censored_at_s"]) == ("", "10.0")
    seconds = {row["phase"]: row for row in rows(made["phases.csv"]) if row["run"] == "b"}
    assert (seconds["evaluation"]["is_training"], seconds["joint"]["is_training"]) == ("False", "True")
    assert float(seconds["unaccounted"]["seconds"]) == pytest.approx(1.0)


def test_runs_are_named_by_the_shortest_ends_that_tell_them_apart(tmp_path: Path) -> None:
    assert run_names([tmp_path / "x" / "draft", tmp_path / "x" / "paper"]) == ["draft", "paper"]
    assert run_names([tmp_path / "x" / "draft", tmp_path / "y" / "draft"]) == ["x/draft", "y/draft"]
    assert run_names([tmp_path / "019e" / "run"]) == ["019e"]  # the run of a job
    file = write_run(tmp_path / "z", metrics()) / "metrics.json"
    assert run_names([file]) == ["z"]
    with pytest.raises(ValueError, match="given twice"):
        run_names([tmp_path / "z", file])


def test_a_run_is_read_by_its_folder_or_its_file(tmp_path: Path) -> None:
    folder = write_run(tmp_path / "run", metrics(point(1, 25.0)))
    assert read_run(folder) == read_run(folder / "metrics.json") == metrics(point(1, 25.0))


def test_a_folder_without_numbers_is_named_with_a_remedy(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match=r"metrics\.json: not found\. Give the folder of a run"):
        read_run(tmp_path)


def _without(key: str) -> dict[str, Any]:
    return {name: value for name, value in values(point(1, 25.0)).items() if name != key}


@pytest.mark.parametrize(
    ("broken", "word"),
    [
        (_without("phases_s"), "phases_s: Field required"),
        (values(curve=[{"iteration": 1}]), r"curve\[0\]\.train_s"),
        (values(schema="graings.run/1"), "graings.metrics/1"),
        (values(train_s=math.nan), "NaN is not strict JSON"),
    ],
)
def test_numbers_that_cannot_be_used_are_refused_by_file_and_key(
    tmp_path: Path, broken: dict[str, Any], word: str
) -> None:
    with pytest.raises(CheckpointError, match=rf"metrics\.json.*{word}"):
        read_run(write_run(tmp_path / "run", broken))


def test_the_summary_names_quality_time_and_targets() -> None:
    assert summary(part("a", *line(1, 100))) == (
        "a: 40.00 dB after 1.67 min of training (2.5 min CPU time); "
        "time to 25 dB 3.16 s, 30 dB 10 s, 35 dB 31.6 s, 40 dB 1.67 min"
    )
    assert "no held-out view" in summary(part("b"))
