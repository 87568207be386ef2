"""Inspection: check that training can start on an unpacked capture.

Third-party libraries decode uploaded images and COLMAP models. They run in a separate process, so that a crash or lack
of memory there does not end the service.
"""

from __future__ import annotations

from pathlib import Path

from anyio import BrokenWorkerProcess, to_process

from graings.capture.load import load_capture
from graings.config import CaptureConfig
from graings.errors import CaptureError
from jobs.store import capture_root

_Defect = tuple[str, str, str | None, str]  # problem, file, field, remedy


async def inspect_capture(folder: Path, config: CaptureConfig) -> None:
    """Raise `CaptureError` if training cannot start on the unpacked capture; it names files by their path in it."""
    try:
        defect = await to_process.run_sync(_find_defect, folder, config, cancellable=True)
    except BrokenWorkerProcess as error:
        raise CaptureError(
            "reading it ended the reading process",
            file="the archive",
            remedy="Open its images, and its COLMAP model if it has one, in the programs that wrote them, and save"
            " again the files that cannot be read.",
        ) from error
    if defect is not None:
        problem, file, field, remedy = defect
        raise CaptureError(problem, file=file, field=field, remedy=remedy)


def _find_defect(folder: Path, config: CaptureConfig) -> _Defect | None:
    root = capture_root(folder)

    def relative(text: str) -> str:
        return text.replace(f"{root}/", "").replace(str(root), "the archive")

    try:
        load_capture(root, config)
    except CaptureError as error:  # as a tuple: pickle cannot restore its keyword arguments
        return relative(error.problem), relative(error.file), error.field, relative(error.remedy)
    return None
