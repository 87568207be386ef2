"""Inspection: check that training can start on an unpacked capture, and plan it.

Third-party libraries decode uploaded images and COLMAP models. They run in a separate process, so that a crash or lack
of memory there does not end the service.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple, TypeVar

from anyio import BrokenWorkerProcess, to_process

from graings.capture.load import load_capture
from graings.capture.synthetic import RECIPE_FILE, find_recipe
from graings.config import CaptureConfig, TrainConfig
from graings.errors import CaptureError
from graings.footage.source import find_footage
from graings.inspection import inspect as inspection
from graings.inspection.document import Inspection
from graings.plan.cost import stored_calibration
from graings.plan.plan import Plan
from graings.plan.survey import survey
from jobs.store import capture_root


class Defect(NamedTuple):
    """A `CaptureError` as it travels between processes: pickle cannot restore its keyword arguments."""

    problem: str
    file: str
    field: str | None
    remedy: str


Found = TypeVar("Found")


async def inspect_capture(folder: Path, config: CaptureConfig) -> None:
    """Raise `CaptureError` if training cannot start on the unpacked capture; it names files by their path in it."""
    await apart(_find_defect, folder, config)


async def plan_capture(folder: Path, config: TrainConfig) -> Plan:
    """The plan of training with `config` on the unpacked capture. Raises `CaptureError` as `inspect_capture` does."""
    planned = await apart(_make_plan, folder, config)
    return Plan.model_validate_json(planned)


async def describe_capture(folder: Path, config: CaptureConfig) -> Inspection:
    """The inspection of the unpacked capture. Raises `CaptureError` as `inspect_capture` does."""
    described = await apart(_describe, folder, config)
    return Inspection.model_validate_json(described)


async def apart(look: Callable[..., Found | Defect], *arguments: object) -> Found:
    """What `look` finds in another process. Raises `CaptureError` for a defect."""
    try:
        found = await to_process.run_sync(look, *arguments, cancellable=True)
    except BrokenWorkerProcess as error:
        raise CaptureError(
            "reading it ended the reading process",
            file="the archive",
            remedy="Open its images, and its COLMAP model if it has one, in the programs that wrote them, and save"
            " again the files that cannot be read.",
        ) from error
    if isinstance(found, Defect):
        raise CaptureError(found.problem, file=found.file, field=found.field, remedy=found.remedy)
    return found


def _find_defect(folder: Path, config: CaptureConfig) -> Defect | None:
    root = capture_root(folder)
    try:
        if find_recipe(root) is not None or find_footage(root) is not None:
            return None  # the job makes the capture first; of footage it says there what is wrong
        load_capture(root, config)
    except CaptureError as error:
        return defect(root, error)
    return None


def _make_plan(folder: Path, config: TrainConfig) -> Defect | str:
    """The plan as JSON. The service measures no times itself: it uses the calibration of an earlier training."""
    root = capture_root(folder)
    try:
        if (missing := _without_views("a plan", root)) is not None:
            return missing
        return survey(root, config, stored_calibration()).model_dump_json(by_alias=True)
    except CaptureError as error:
        return defect(root, error)


def _describe(folder: Path, config: CaptureConfig) -> Defect | str:
    """The inspection as JSON."""
    root = capture_root(folder)
    try:
        if (missing := _without_views("an inspection", root)) is not None:
            return missing
        return inspection.inspect_capture(root, config, stored_calibration())[0].model_dump_json(by_alias=True)
    except CaptureError as error:
        return defect(root, error)


def _without_views(what: str, root: Path) -> Defect | None:
    """Why there is no `what` of a capture that a job makes first; None for a capture. Raises `CaptureError`."""
    if find_recipe(root) is not None:
        remedy = "Submit it as a job, or draw it first: graings synthesize."
        return Defect(f"{what} needs the images, which are not drawn yet", RECIPE_FILE, None, remedy)
    if (footage := find_footage(root)) is None:
        return None
    remedy = "Submit it as a job, or make a capture of it first: graings capture."
    return Defect(f"{what} needs the cameras, which are not known yet", footage.name, None, remedy)


def defect(root: Path, error: CaptureError) -> Defect:
    """The error, with files by their path in the archive."""

    def relative(text: str) -> str:
        return text.replace(f"{root}/", "").replace(str(root), "the archive")

    return Defect(relative(error.problem), relative(error.file), error.field, relative(error.remedy))
