"""Store: captures and jobs on disk.

    <root>/captures/<sha256>/    an unpacked capture, shared by all jobs that use it
    <root>/jobs/<id>/            job.json, attempts.json, progress.jsonl, log.txt, lock, run/ (the trainer's own)
    <root>/uploads/              archives on their way in
    <root>/workers/              leases of workers on this machine

Every file appears whole or not at all. The store knows nothing of queues: whether a job runs is not its concern.
"""

from __future__ import annotations

import json
import logging
import os
import shutil
import time
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from graings.storage.run_folder import MODEL_FILE, newest_checkpoint
from jobs.files import locked, sync_folder, sync_tree, write_json
from jobs.job import Attempt, JobConflict, JobDamaged, JobNotFound, JobSpec, check_id, is_id

LOG = logging.getLogger(__name__)

KEPT_ATTEMPTS = 50
# An upload to which nothing was written for so long has nobody who works on it.
LEFTOVER_S = 3_600.0


@dataclass(frozen=True, slots=True)
class JobFolder:
    """The files of one job."""

    path: Path

    @property
    def run(self) -> Path:
        return self.path / "run"

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
        return self.run / "metrics.json"

    @property
    def curve(self) -> Path:
        return self.run / "curve.svg"

    @property
    def report(self) -> Path:
        return self.run / "report"

    @property
    def model(self) -> Path:
        return self.run / MODEL_FILE

    def spec(self) -> JobSpec:
        """What was asked for. Raises `JobDamaged`, and `JobNotFound` for a job that was deleted meanwhile."""
        file = self.path / "job.json"
        try:
            return JobSpec(**json.loads(file.read_text())["spec"])
        except (OSError, ValueError, KeyError, TypeError) as error:
            if not self.path.is_dir():
                raise JobNotFound(self.path.name) from error
            raise JobDamaged(f"{file}: not readable ({error!r}). Delete the job and send its capture again.") from error

    def created_at(self) -> float:
        """Unix seconds; ids begin with them."""
        return int(self.path.name[:11], 16) / 1000.0

    def checkpoint(self) -> int | None:
        """The iteration of the newest checkpoint, or None."""
        newest = newest_checkpoint(self.run)
        return None if newest is None else int(newest.name)

    def attempts(self) -> list[Attempt]:
        """The last starts of the trainer, oldest first."""
        file = self.path / "attempts.json"
        try:
            return [Attempt(**values) for values in json.loads(file.read_text())]
        except FileNotFoundError:
            return []
        except (OSError, ValueError, TypeError) as error:
            raise JobDamaged(f"{file}: not readable ({error!r}). Remove that file; only a count is lost.") from error

    def begin_attempt(self, worker: str) -> Attempt:
        """Record a start, before it happens: a start that kills its worker counts too."""
        attempts = self.attempts()
        number = attempts[-1].number + 1 if attempts else 1
        attempt = Attempt(number, worker, time.time(), self.checkpoint() or 0)
        self._write_attempts([*attempts, attempt])
        return attempt

    def end_attempt(self, attempt: Attempt, exit_code: int, message: str | None = None) -> None:
        """Record how an attempt ended."""
        ended = replace(attempt, ended_at=time.time(), exit_code=exit_code, message=message)
        self._write_attempts([ended if one.number == attempt.number else one for one in self.attempts()])

    def close_attempts(self) -> None:
        """The job has ended: what happened so far no longer counts against the attempts to come."""
        self._write_attempts([replace(one, final=True) for one in self.attempts()])

    def _write_attempts(self, attempts: list[Attempt]) -> None:
        write_json(self.path / "attempts.json", [asdict(one) for one in attempts[-KEPT_ATTEMPTS:]])


class Store:
    """The folder that holds everything; see the module for its layout."""

    def __init__(self, root: Path) -> None:
        self.root = root.resolve()
        self._captures = self.root / "captures"
        self._jobs = self.root / "jobs"
        self.uploads = self.root / "uploads"
        self.workers = self.root / "workers"
        for folder in (self._captures, self._jobs, self.uploads, self.workers):
            folder.mkdir(parents=True, exist_ok=True)

    def capture(self, digest: str) -> Path:
        """Where the capture's files begin."""
        return capture_root(self._captures / digest)

    def create(self, spec: JobSpec, unpacked: Path) -> str:
        """A new job whose capture lies in the folder `unpacked`, which is moved into the store. Returns its id."""
        now = time.time()
        job_id = f"{int(now * 1000):011x}{uuid.uuid4().hex[:5]}"
        sync_tree(unpacked)  # a job that the disk remembers must not have lost its images
        with self._changing():
            capture = self._captures / spec.capture
            if _files(capture) == _files(unpacked):
                shutil.rmtree(unpacked)
            else:
                # New, or a file of it was lost since: what has just arrived is whole.
                if capture.exists():
                    capture.rename(self.uploads / f"{job_id}.replaced")
                unpacked.rename(capture)
                sync_folder(self._captures)
                shutil.rmtree(self.uploads / f"{job_id}.replaced", ignore_errors=True)
            # The record is written first and the folder renamed last: a folder in jobs/ always has its record.
            part = self.uploads / f"{job_id}.job"
            part.mkdir()
            write_json(part / "job.json", {"id": job_id, "created_at": now, "spec": asdict(spec)})
            part.rename(self._jobs / job_id)
            sync_folder(self._jobs)
        return job_id

    def folder(self, job_id: str) -> JobFolder:
        """The files of a job. Raises `JobNotFound`."""
        path = self._jobs / check_id(job_id)
        if not path.is_dir():
            raise JobNotFound(job_id)
        return JobFolder(path)

    def ids(self) -> list[str]:
        """All jobs, newest first: ids begin with the time. What else lies in their folder is none of ours."""
        found = [one.name for one in self._jobs.iterdir() if is_id(one.name) and one.is_dir()]
        return sorted(found, reverse=True)

    def delete(self, job_id: str) -> None:
        """Remove a job, and its capture when no other job uses it. Raises `JobConflict` while its trainer is at it."""
        folder = self.folder(job_id)
        with self._changing(), locked(folder.lock, wait=False) as free:
            if not free:
                raise JobConflict(f"Job {job_id} is still writing its checkpoint. Try again in a few seconds.")
            bin_ = self.uploads / f"{job_id}.deleted"
            os.utime(folder.path)  # so that nobody else takes it for a leftover meanwhile
            folder.path.rename(bin_)
            shutil.rmtree(bin_)
            try:
                used = {self.folder(other).spec().capture for other in self.ids()}
            except JobDamaged:
                return  # a capture that nobody seems to use may be that job's
            for capture in self._captures.iterdir():
                if capture.name not in used:
                    shutil.rmtree(capture, ignore_errors=True)

    @contextmanager
    def _changing(self) -> Iterator[None]:
        """One at a time adds or removes jobs and captures, whichever process it is in."""
        with locked(self.root / "store.lock"):
            yield


def discard_leftovers(uploads: Path) -> None:
    """Remove what processes that died left in `uploads`; other processes may be at work on the rest.

    What cannot be removed is logged and stays: it is no reason to refuse an upload.
    """
    # An archive is only read while it is unpacked beside: paths of one upload have one name and live as long.
    groups: dict[str, list[Path]] = {}
    for one in uploads.iterdir():
        groups.setdefault(one.name.partition(".")[0], []).append(one)
    for paths in groups.values():
        try:
            if time.time() - max(_last_write(one) for one in paths) < LEFTOVER_S:
                continue
            for one in paths:
                if one.is_dir():
                    shutil.rmtree(one)
                else:
                    one.unlink()
        except FileNotFoundError:
            continue  # another process was faster
        except OSError as error:
            LOG.warning("What an upload left cannot be removed: %s", error)


def _last_write(path: Path) -> float:
    """Unix seconds of the last change to the file, or to anything in the folder. Raises `FileNotFoundError`."""
    return max(one.lstat().st_mtime for one in (path, *path.rglob("*")))


def capture_root(folder: Path) -> Path:
    """Where the files of an unpacked archive begin: below folders that hold nothing but one folder."""
    while True:
        inside = list(folder.iterdir()) if folder.is_dir() else []
        if len(inside) != 1 or not inside[0].is_dir():
            return folder
        folder = inside[0]


def _files(folder: Path) -> dict[str, int]:
    """Sizes of the files below a folder, by path; none where it is missing."""
    return {str(one.relative_to(folder)): one.stat().st_size for one in folder.rglob("*") if one.is_file()}
