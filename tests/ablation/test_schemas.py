"""The published schemas: equal to the models, and true of the documents as an independent validator sees it."""

from __future__ import annotations

import json
import runpy
from pathlib import Path
from typing import Any

import pytest
from jsonschema import Draft202012Validator, ValidationError

from graings.ablation.experiment import Ablation
from graings.export.export import SequenceFrame, SequenceManifest
from graings.footage.report import FootageCamera, FootageReport
from graings.inspection.inspect import inspect_capture
from graings.player.scene_file import read_scene, scene_bytes
from graings.render import FastScene, PreparedScene
from graings.report import events, start_events
from graings.report.events import Event, Grew, StepSkipped
from graings.report.folder import report_runs
from graings.storage.compact import open_model
from jobs.progress import ProgressReport
from tests.ablation.tiny import SETTINGS

ROOT = Path(__file__).resolve().parents[2]
SCRIPT = runpy.run_path(str(ROOT / "scripts" / "write_schemas"))

# One of each kind.
EVENTS: tuple[Event, ...] = (
    start_events.BackgroundFound(iteration=1, color=(0.0, 0.0, 0.0)),
    start_events.PointsInitialized(iteration=1, source="random", triangulated=None),
    start_events.PointsInitialized(iteration=1, source="random", triangulated=12),
    start_events.PointsInitialized(iteration=1, source="triangulation", triangulated=4_000, interpolated=900),
    start_events.TimeWindowStarted(iteration=1, share=0.25),
    start_events.LowResolutionStarted(iteration=1, factor=2),
    start_events.MotionFound(iteration=1, tracked_points=400),
    Grew(iteration=200, anchors=3),
    events.GrowthCapped(iteration=200, anchors=90, max_anchors=100),
    events.Pruned(iteration=200, anchors=2),
    events.Unseen(iteration=200, anchors=2),
    events.Thinned(iteration=200, anchors_before=100, anchors_after=50),
    events.GrowthQuiet(iteration=200, growths=5, ended=True),
    events.PartDropped(iteration=400, component="residual", bound=0.001),
    events.GradientsClipped(iteration=201, group="color", norm=1e10, limit=2.5, views=("a", "b")),
    StepSkipped(iteration=202, non_finite="the loss", views=("a",), times=(0.25,)),
    events.RolledBack(iteration=203, to_iteration=150, reason="the loss was not finite", rate_factor=0.5),
    events.OpacityReset(iteration=204, opacity=0.1, shift=2.0),
    events.Restarted(iteration=400, missing_share=0.5, time_window=0.25),
    events.Stiff(iteration=500, step_over_size=1.5),
    events.Diverged(iteration=500, reason="Training diverged."),
)

REPORT = ProgressReport(phase="joint", iteration=202, iterations=500, attempt=1, loss=0.1, events=EVENTS)


FOOTAGE = FootageReport(
    source="clip.mp4",
    seen=900,
    taken=99,
    registered=98,
    left_out=("00007.png",),
    blurred=("00009.png",),
    points=2_000,
    reprojection_error=0.5,
    track_length=12.5,
    parallax=9.0,
    path_over_depth=0.8,
    duration=30.0,
    camera=FootageCamera(width=640, height=480, focal=600.0, field_of_view=56.0, distortion=-0.05),
    seconds={"frames": 2.0},
)


def validator(name: str) -> Draft202012Validator:
    schema = json.loads((ROOT / "docs" / "schemas" / f"{name}.json").read_text())
    Draft202012Validator.check_schema(schema)
    return Draft202012Validator(schema)


@pytest.fixture(scope="module")
def documents(capture: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """A document of each kind, as a program finds it."""
    folder = tmp_path_factory.mktemp("ablation")
    experiment = Ablation(folder, capture, preset="draft", settings=SETTINGS, rows=("full",), seeds=(0,), threads=1)
    for _, run in experiment:
        assert list(run)
    run = folder / "full" / "seed-0"
    model = open_model(run)
    splats = SequenceFrame(file="0000.ply", t=0.0, capture_time=0.0, splats=9)
    sequence = SequenceManifest(up=(0.0, 0.0, 1.0), degree=0, frames=(splats,))
    report_runs([run], run / "report", budget_s=0.0)
    files = {
        "ablation": folder / "ablation.json",
        "run": run / "run.json",
        "metrics": run / "metrics.json",
        "work_precision": run / "report" / "work_precision.json",
    }
    read = {name: json.loads(file.read_text()) for name, file in files.items()}
    assert len(read["work_precision"]["render"]) == 1
    return read | {
        "plan": read["run"]["plan"],
        "progress": json.loads(REPORT.model_dump_json()),
        "event": EVENTS[0].to_json(),
        "footage": FOOTAGE.to_json(),
        "inspection": inspect_capture(capture)[0].to_json(),
        "motion_basis": FastScene.of(PreparedScene(model.scene), model.views["train"]).report.to_json(),
        "ply_sequence": sequence.to_json(),
        "player_scene": read_scene(scene_bytes(model))[1].to_json(),
    }


def test_the_published_schemas_are_those_of_the_models(tmp_path: Path) -> None:
    SCRIPT["write"](tmp_path)
    published = {file.name: file.read_text() for file in (ROOT / "docs" / "schemas").iterdir()}
    assert {file.name: file.read_text() for file in tmp_path.iterdir()} == published, "run scripts/write_schemas"


@pytest.mark.parametrize("name", sorted(SCRIPT["DOCUMENTS"]))
def test_a_document_of_each_kind_is_valid(documents: dict[str, Any], name: str) -> None:
    validator(name).validate(documents[name])


@pytest.mark.parametrize("name", sorted(SCRIPT["DOCUMENTS"]))
def test_an_unknown_field_is_not_valid(documents: dict[str, Any], name: str) -> None:
    with pytest.raises(ValidationError):
        validator(name).validate({**documents[name], "unknown": 1})


@pytest.mark.parametrize("event", EVENTS, ids=lambda event: event.kind)
def test_every_event_is_valid_and_has_a_message(event: Event) -> None:
    values = event.to_json()
    validator("event").validate(values)
    assert len(values["message"]) > 10
    assert values["message"] == event.message


def test_there_is_an_example_of_every_kind_of_event() -> None:
    mapping = SCRIPT["schema"]("event")["discriminator"]["mapping"]
    assert {event.kind for event in EVENTS} == set(mapping)


@pytest.mark.parametrize("name", sorted(SCRIPT["DOCUMENTS"]))
def test_every_field_is_described(name: str) -> None:
    schema = SCRIPT["schema"](name)
    objects = [schema, *schema.get("$defs", {}).values()]
    missing = [
        f"{part.get('title')}.{field}"
        for part in objects
        for field, facts in part.get("properties", {}).items()
        if not facts.keys() & {"description", "$ref"}  # a reference to a model with the same description has no other
    ]
    assert [field for field in missing if not field.startswith("TrainConfig.")] == []
