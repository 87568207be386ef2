"""Inspection: whether training could begin on an unpacked capture.

Files of strangers go through readers of images and of COLMAP models that are not ours. They run in a process beside
the service, which a crash or a shortage of memory there does not reach. Knows nothing of requests.
"""

from __future__ import annotations

from pathlib import Path

from anyio import BrokenWorkerProcess, to_process

from graings.capture.load import load_capture
from graings.config import CaptureConfig
from graings.errors import CaptureError
from jobs.store import capture_root

_Complaint = tuple[str, str, str | None, str]  # problem, file, field, remedy


async def inspect_capture(folder: Path, config: CaptureConfig) -> None:
    """Raises `CaptureError` where training could not begin on the unpacked capture; files by their place in it."""
    try:
        complaint = await to_process.run_sync(_complaint, folder, config, cancellable=True)
    except BrokenWorkerProcess as error:
        raise CaptureError(
            "reading it ended the process that did",
            file="the archive",
            remedy="Open its images, and its COLMAP model where it has one, with the programs they come from, and save"
            " again what those cannot read.",
        ) from error
    if complaint is not None:
        problem, file, field, remedy = complaint
        raise CaptureError(problem, file=file, field=field, remedy=remedy)


def _complaint(folder: Path, config: CaptureConfig) -> _Complaint | None:
    root = capture_root(folder)

    def as_sent(text: str) -> str:
        return text.replace(f"{root}/", "").replace(str(root), "the archive")

    try:
        load_capture(root, config)
    except CaptureError as error:  # in parts: it takes its arguments by name, which pickle does not
        return as_sent(error.problem), as_sent(error.file), error.field, as_sent(error.remedy)
    return None
