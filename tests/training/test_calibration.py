"""The calibration of a machine, and costs predicted with it."""

from __future__ import annotations

from pathlib import Path

import pytest

import graings
from graings.config import make_config
from graings.plan.cost import CALIBRATION_FILE, TERMS, Calibration, Load, predict, stored_calibration
from graings.plan.plan import make_plan
from graings.storage.files import write_document
from graings.training import calibration as module
from graings.training.calibration import calibration, kept_calibration
from tests.plan.test_rules import FACTS

MADE = Calibration(
    version=graings.__version__,
    cpu="x",
    threads=1,
    step=0.01,
    view=0.004,
    pixel=0.2,
    gaussian=0.1,
    gaussian_view=0.1,
    deformation=3.0,
    deformation_view=0.4,
    residual_view=0.4,
    float32=2.0,
    wall_over_cpu=0.9,
    error=0.1,
    cost_s=5.0,
)


@pytest.mark.slow(reason="times steps of ten sizes, eight CPU seconds")
def test_a_calibration_is_made_once_and_fits_its_own_steps(tmp_path: Path) -> None:
    made = calibration(1, tmp_path)
    assert made.error < 0.3
    assert made.step > 0
    assert made.deformation + made.deformation_view > 0
    assert calibration(1, tmp_path) == made == stored_calibration(tmp_path)


def test_a_calibration_of_another_version_or_thread_count_is_not_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[int] = []

    def count(threads: int) -> Calibration:
        asked.append(threads)
        return MADE.model_copy(update={"cpu": module.machine_facts().cpu, "threads": threads})

    monkeypatch.setattr(module, "measure_calibration", count)
    assert calibration(1, tmp_path).threads == 1
    assert calibration(1, tmp_path).threads == 1
    assert asked == [1]
    calibration(2, tmp_path)
    assert asked == [1, 2]
    assert kept_calibration(2, tmp_path) == stored_calibration(tmp_path) is not None
    assert kept_calibration(1, tmp_path) is None
    file = tmp_path / CALIBRATION_FILE
    made = file.read_text()
    file.write_text(made.replace(graings.__version__, "0.0.0"))
    assert stored_calibration(tmp_path) is None
    assert kept_calibration(2, tmp_path) is None
    calibration(2, tmp_path)
    assert asked == [1, 2, 2]
    write_document(file, MADE.model_copy(update={"cpu": "of another machine", "threads": 2}))
    assert kept_calibration(2, tmp_path) is None


def test_a_damaged_calibration_counts_as_none(tmp_path: Path) -> None:
    assert stored_calibration(tmp_path) is None
    (tmp_path / CALIBRATION_FILE).write_text("{")
    assert stored_calibration(tmp_path) is None


def test_the_cost_grows_with_steps_views_pixels_and_detail() -> None:
    def cost(facts: dict[str, object] | None = None, **options: object) -> float:
        return predict(FACTS.model_copy(update=facts or {}), make_config("standard", options), MADE).cpu_s

    plain = cost()
    assert cost(iterations=10_000) == pytest.approx(2 * plain, rel=5e-3)
    assert cost(batch=8) > plain > cost({"pixels": 1_024}) > 0
    assert cost({"detail": 0.9}) > plain
    assert cost(**{"scene.deformation": "none", "scene.residual": False}) < plain


def test_networks_in_float32_cost_what_the_calibration_found() -> None:
    def cost(precision: str) -> float:
        return predict(FACTS, make_config("standard", {"network_precision": precision}), MADE).cpu_s

    assert cost("auto") == cost("bfloat16")
    assert cost("auto") < cost("float32") < MADE.float32 * cost("auto")


def test_what_a_plan_drops_makes_the_training_cheaper_by_what_it_says() -> None:
    facts, config = FACTS.model_copy(update={"times": 1}), make_config("standard")
    plan = make_plan(facts, config, MADE)
    kept = make_plan(facts, make_config("standard", {"plan.keep": ["deformation", "residual"]}), MADE)
    assert plan.prediction is not None
    assert kept.prediction is not None
    decisions = [plan.decision("deformation"), plan.decision("residual")]
    savings = [decision.saving for decision in decisions if decision is not None]
    total = sum(saving.predicted_s or 0.0 for saving in savings if saving is not None)
    whole = predict(facts, config, MADE).cpu_s
    assert plan.prediction.cpu_s == pytest.approx(whole - total, rel=0.02)
    assert kept.prediction.cpu_s == pytest.approx(whole)


def test_an_error_of_a_prediction_is_relative() -> None:
    prediction = predict(FACTS, make_config("draft"), MADE)
    assert prediction.compared(prediction.cpu_s / 1.25).error == pytest.approx(0.25)


def test_every_time_of_a_calibration_has_a_factor() -> None:
    load = Load(views=4, pixels=1e6, gaussians=1e6, deformation=True, residual=True)
    assert dict(zip(TERMS, load.terms(), strict=True)) == {
        "step": 1, "view": 4, "pixel": 4, "gaussian": 1, "gaussian_view": 4, "deformation": 1, "deformation_view": 4,
        "residual_view": 4,
    }  # fmt: skip


def test_a_cache_that_cannot_be_written_is_named_and_the_times_are_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(module, "measure_calibration", lambda threads: MADE)
    (tmp_path / "file").touch()
    assert calibration(1, tmp_path / "file" / "graings") == MADE
    assert str(tmp_path / "file" / "graings") in caplog.text
