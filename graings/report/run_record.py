"""RunRecord: what a run trains, on which capture and with which versions, as `run.json` holds it."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import Field

from graings.config import TrainConfig
from graings.document import Document, read_document
from graings.errors import CheckpointError
from graings.plan.plan import Plan
from graings.report.machine import VersionFacts
from graings.storage.run_folder import PLAN_FILE, RECORD_FILE


class CaptureSource(Document):
    """Where the capture of a run was, and what identifies it."""

    path: Path = Field(description="Absolute path of the capture at the start of the run.")
    hash: str = Field(description="Hash of its content.")
    kind: str = Field(description="Format of the capture, such as transforms or colmap.")
    notes: tuple[str, ...] = Field(description="What the reader of the capture left out or assumed, in plain words.")


class RunRecord(Document):
    """What a run trains; written once, at its start."""

    schema_name: Literal["graings.run/1"] = Field(
        "graings.run/1", alias="schema", description="Kind and version of this document."
    )
    capture: CaptureSource = Field(description="The capture.")
    config: TrainConfig = Field(description="All options of the run.")
    plan: Plan = Field(description="Components that this scene does not need, as planned at the start.")
    versions: VersionFacts = Field(description="Versions at the start of the run.")


def read_record(run: Path) -> RunRecord:
    """The record of a run folder. Raises `CheckpointError`."""
    file = run / RECORD_FILE
    if not file.exists():
        raise CheckpointError(
            f"{run}: holds no run to resume or evaluate: there is no {RECORD_FILE}. Give the folder of a run, not that "
            "of one of its checkpoints."
        )
    return read_document(file, RunRecord, "Use the version that wrote it, or train again.")


def read_plan(run: Path) -> Plan | None:
    """The plan of a run folder with what training decided; None in a folder without one. Raises `CheckpointError`."""
    file = run / PLAN_FILE
    if not file.exists():
        return None  # the run was interrupted before it wrote one
    return read_document(file, Plan, "Remove it; the plan of the start is in run.json.")
