"""Store: captures and jobs on disk.

    <root>/captures/<sha256>/    an unpacked capture, shared by all jobs that use it
    <root>/jobs/<id>/            job.json, attempts.json, progress.jsonl, log.txt, locks, tasks/<id>/, run/ (the run)
    <root>/submissions/          the job of each idempotency key, as a link
    <root>/uploads/              archives that are being uploaded or unpacked
    <root>/workers/              leases of workers on this machine

Every file is replaced atomically. The state of a job is not here but in the queue (`jobs.engine`).
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import time
from base64 import b64encode
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path

from graings.storage.files import sync, sync_tree, write_json
from graings.storage.locks import locked
from graings.storage.run_folder import CURVE_FILE, METRICS_FILE, MODEL_FILE, PLAN_FILE, RECORD_FILE, newest_checkpoint
from jobs.job import (
    Attempt,
    CaptureNotFound,
    JobConflict,
    JobDamaged,
    JobNotFound,
    JobSpec,
    OtherSubmission,
    check_id,
    is_id,
    new_id,
)

KEPT_ATTEMPTS = 50
RUN = "run"  # the folder of the run in that of its job


@dataclass(frozen=True, slots=True)
class JobFolder:
    """The files of one job."""

    path: Path

    @property
    def run(self) -> Path:
        return self.path / RUN

    @property
    def capture(self) -> Path:
        """The capture that was made of a video, of photographs, or of a synthetic scene."""
        return self.path / "capture"

    @property
    def log(self) -> Path:
        return self.path / "log.txt"

    @property
    def progress(self) -> Path:
        return self.path / "progress.jsonl"

    @property
    def lock(self) -> Path:
        return self.path / "lock"

    @property
    def metrics(self) -> Path:
        return self.run / METRICS_FILE

    @property
    def plan(self) -> Path:
        return self.run / PLAN_FILE

    @property
    def curve(self) -> Path:
        return self.run / CURVE_FILE

    @property
    def report(self) -> Path:
        return self.run / "report"

    @property
    def model(self) -> Path:
        return self.run / MODEL_FILE

    @property
    def tasks(self) -> Path:
        """A folder for each evaluation and video that was asked for (`jobs.task`)."""
        return self.path / "tasks"

    def spec(self) -> JobSpec:
        """The specification. Raises `JobDamaged`, and `JobNotFound` if the job was deleted meanwhile."""
        file = f"{self.path}/job.json"  # read for each job of a list: a Path would take longer than the disk
        try:
            return _read_spec(file, os.stat(file).st_mtime_ns)
        except (OSError, ValueError, KeyError, TypeError) as error:
            if not self.path.is_dir():
                raise JobNotFound(self.path.name) from error
            raise JobDamaged(
                f"{file}: not readable ({error!r}). Delete the job and submit its capture again."
            ) from error

    def write_spec(self, spec: JobSpec) -> None:
        """Replace the specification."""
        file = self.path / "job.json"
        write_json(file, {**json.loads(file.read_text()), "spec": asdict(spec)})

    def created_at(self) -> float:
        """Unix seconds, which are the first part of the id."""
        return int(self.path.name[:11], 16) / 1000.0

    def run_files(self) -> frozenset[str]:
        """Names of the files and folders of the run; none before the training has begun."""
        try:
            return frozenset(os.listdir(self.run))
        except (FileNotFoundError, NotADirectoryError):
            return frozenset()

    def checkpoint(self) -> int | None:
        """The iteration of the newest checkpoint, or None."""
        newest = newest_checkpoint(self.run)
        return None if newest is None else int(newest.name)

    def trained_iterations(self) -> int:
        """The iterations for which the run is configured, as its record says; a restart adds to them."""
        file = self.run / RECORD_FILE
        try:
            return int(json.loads(file.read_text())["config"]["iterations"])
        except (OSError, ValueError, KeyError, TypeError) as error:
            remedy = "Delete the job and submit its capture again."
            raise JobDamaged(f"{file}: not readable ({error!r}). {remedy}") from error

    def attempts(self) -> list[Attempt]:
        """The last `KEPT_ATTEMPTS` starts of the trainer, oldest first."""
        file = self.path / "attempts.json"
        try:
            return [Attempt(**values) for values in json.loads(file.read_text())]
        except FileNotFoundError:
            return []
        except (OSError, ValueError, TypeError) as error:
            raise JobDamaged(f"{file}: not readable ({error!r}). Remove that file.") from error

    def begin_attempt(self, worker: str) -> Attempt:
        """Record a start of the trainer, before it happens: a start that kills its worker counts too."""
        attempts = self.attempts()
        number = attempts[-1].number + 1 if attempts else 1
        attempt = Attempt(number, worker, time.time(), self.checkpoint() or 0)
        self._write_attempts([*attempts, attempt])
        return attempt

    def end_attempt(self, attempt: Attempt, exit_code: int, message: str | None = None) -> None:
        """Record how an attempt ended."""
        ended = replace(attempt, ended_at=time.time(), exit_code=exit_code, message=message)
        self._write_attempts([ended if old.number == attempt.number else old for old in self.attempts()])

    def close_attempts(self) -> None:
        """Mark all attempts as final when the job has ended, so that a retry does not count them."""
        self._write_attempts([replace(attempt, final=True) for attempt in self.attempts()])

    def _write_attempts(self, attempts: list[Attempt]) -> None:
        write_json(self.path / "attempts.json", [asdict(attempt) for attempt in attempts[-KEPT_ATTEMPTS:]])


class Store:
    """The data folder; see the module for its layout."""

    def __init__(self, root: Path) -> None:
        self.root = root.resolve()
        self._captures = self.root / "captures"
        self._jobs = self.root / "jobs"
        self._submissions = self.root / "submissions"
        self.uploads = self.root / "uploads"
        self.workers = self.root / "workers"
        for folder in (self._captures, self._jobs, self._submissions, self.uploads, self.workers):
            folder.mkdir(parents=True, exist_ok=True)

    def capture(self, digest: str) -> Path:
        """The folder with the files of a capture."""
        return capture_root(self._captures / digest)

    def trained_on(self, job_id: str) -> Path:
        """The folder of the capture of a job: its upload, or what was made of a video or of photographs."""
        folder = self.folder(job_id)
        return folder.capture if folder.capture.is_dir() else self.capture(folder.spec().capture)

    def create(self, spec: JobSpec, unpacked: Path | None, key: str | None = None) -> str:
        """Add a job whose capture is in the folder `unpacked`, which is moved into the store; None: one it has.

        Returns its id; with a `key` that its owner has used, that of the job of then. Raises `OtherSubmission` if that
        job was submitted differently, and `CaptureNotFound` where the capture is not there any more.
        """
        now = time.time()
        job_id = new_id(now)
        if unpacked is not None:
            sync_tree(unpacked)  # after a power failure no job may be there without its images
        submission = self._submissions / hashlib.sha256(f"{spec.owner} {key}".encode()).hexdigest()
        with self.changing():
            if key is not None and submission.exists():
                if json.loads((submission / "job.json").read_text())["submitted"] != asdict(spec):
                    raise OtherSubmission("This Idempotency-Key was used with other content. Choose a new one.")
                return submission.resolve().name
            capture = self._captures / spec.capture
            if unpacked is None:
                if not capture.is_dir():
                    raise CaptureNotFound(spec.capture)
            elif _files(capture) == _files(unpacked):
                shutil.rmtree(unpacked)
            else:
                # A new capture, or one with missing files: replace it with the complete upload.
                if capture.exists():
                    capture.rename(self.uploads / f"{job_id}.replaced")
                unpacked.rename(capture)
                sync(self._captures)
                shutil.rmtree(self.uploads / f"{job_id}.replaced", ignore_errors=True)
            # The folder is renamed after its record is written: a folder in jobs/ always has its record.
            part = self.uploads / f"{job_id}.job"
            part.mkdir()
            values = asdict(spec)
            secret = "whsec_" + b64encode(os.urandom(32)).decode() if spec.webhook else None
            stored = {"spec": {**values, "webhook_secret": secret}, "submitted": values}
            write_json(part / "job.json", {"id": job_id, "created_at": now, **stored})
            if key is not None:
                # Before the job is there: the request will be repeated if this process dies in between, and must find
                # the job. A link to a job that is not there counts as none.
                submission.unlink(missing_ok=True)
                submission.symlink_to(self._jobs / job_id)
                sync(self._submissions)
            part.rename(self._jobs / job_id)
            sync(self._jobs)
        return job_id

    def folder(self, job_id: str) -> JobFolder:
        """The files of a job. Raises `JobNotFound`."""
        folder = self.listed_folder(job_id)
        if not folder.path.is_dir():
            raise JobNotFound(job_id)
        return folder

    def listed_folder(self, job_id: str) -> JobFolder:
        """The files of a job that was there a moment ago; that it still is, is not checked."""
        return JobFolder(self._jobs / check_id(job_id))

    def ids(self) -> list[str]:
        """All jobs, newest first, since ids begin with the time. Other files in their folder are ignored."""
        with os.scandir(self._jobs) as entries:
            return sorted((entry.name for entry in entries if is_id(entry.name) and entry.is_dir()), reverse=True)

    def delete(self, job_id: str) -> None:
        """Remove a job, and its capture if no other job uses it. Raises `JobConflict` while its trainer runs."""
        folder = self.folder(job_id)
        with self.changing(), locked(folder.lock, wait=False) as free:
            if not free:
                raise JobConflict(f"Job {job_id} is still writing its checkpoint. Try again in a few seconds.")
            deleted = self.uploads / f"{job_id}.deleted"
            os.utime(folder.path)  # so that no other process takes it for a leftover meanwhile
            folder.path.rename(deleted)
            shutil.rmtree(deleted)
            for submission in self._submissions.iterdir():
                if not submission.exists():
                    submission.unlink()
            try:
                used = {self.folder(other).spec().capture for other in self.ids()}
            except JobDamaged:
                return  # any capture that seems unused may be that of the damaged job
            for capture in self._captures.iterdir():
                if capture.name not in used:
                    shutil.rmtree(capture, ignore_errors=True)

    @contextmanager
    def changing(self) -> Iterator[None]:
        """Only one process at a time adds or removes jobs and captures."""
        with locked(self.root / "store.lock"):
            yield


@lru_cache(maxsize=1_000)
def _read_spec(file: str, modified_ns: int) -> JobSpec:
    """The specification in a file, which is read again only after it was written again."""
    return JobSpec(**json.loads(Path(file).read_text())["spec"])


def capture_root(folder: Path) -> Path:
    """The folder with the files of an unpacked archive, below folders that contain nothing but one folder."""
    while True:
        content = list(folder.iterdir()) if folder.is_dir() else []
        if len(content) != 1 or not content[0].is_dir():
            return folder
        folder = content[0]


def _files(folder: Path) -> dict[str, int]:
    """Sizes of the files below a folder by path; empty if the folder is missing."""
    return {str(path.relative_to(folder)): path.stat().st_size for path in folder.rglob("*") if path.is_file()}
