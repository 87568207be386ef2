"""A service on which a fault is tried: a data folder, a database, and the real processes of the API and of workers.

Two jobs are submitted over HTTP: one that trains for some seconds with a checkpoint every five iterations, and a brief
one that waits behind it. `Stage` starts and stops processes and waits for what a fault needs.
"""

from __future__ import annotations

import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from client import Client, ClientError, RemoteJob
from jobs.progress import last_progress
from jobs.store import JobFolder

TRAINING: dict[str, object] = {
    "iterations": 100, "init.points": 100, "evaluation.checkpoint_every": 5, "evaluation.first": 60,
    "evaluation.views": 1,
}  # fmt: skip
BRIEF = TRAINING | {"iterations": 5}
FAULT_AT = 15  # iterations that the training has done, with checkpoints, before the fault
LONG_S = 240.0
NO_PREFIX: tuple[str, ...] = ()


class Stuck(Exception):
    """Something that should have happened did not."""


class Stage:
    """Processes on the data folder `data` and the database `url`; their output is in `logs`."""

    def __init__(self, data: Path, logs: Path, url: str, capture: Path) -> None:
        self.data, self.logs, self.url, self.capture = data, logs, url, capture
        self.environment = {"GRAINGS_MIN_FREE_MB": "0"}
        self.job = self.behind = ""
        self.api: subprocess.Popen[bytes] | None = None
        self.workers: list[subprocess.Popen[bytes]] = []
        self.notes: list[str] = []
        self.late: list[Callable[[], object]] = []  # what starts once the first worker trains
        self.retried: set[str] = set()
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self._port = int(probe.getsockname()[1])

    def _start(self, name: str, command: Sequence[str]) -> subprocess.Popen[bytes]:
        with (self.logs / f"{name}.log").open("ab") as log:
            return subprocess.Popen(command, stdout=log, stderr=log, env={**os.environ, **self.environment})

    def start_api(self) -> None:
        command = [sys.executable, "-m", "service.commands", "--port", str(self._port)]
        self.api = self._start("api", [*command, "--data", str(self.data), "--database", self.url])
        self.until(self.answers, "the API answers")

    def start_worker(
        self,
        *,
        prefix: Sequence[str] = NO_PREFIX,
        program: Sequence[str] = ("-m", "jobs.commands"),
    ) -> subprocess.Popen[bytes]:
        command = [*prefix, sys.executable, *program, "--data", str(self.data), "--database", self.url]
        self.workers.append(self._start("worker", [*command, "--threads", "1", "--nice", "0"]))
        return self.workers[-1]

    def client(self) -> Client:
        return Client(f"http://127.0.0.1:{self._port}", timeout=90.0)

    def answers(self) -> bool:
        """Whether the API answers and has the database."""
        try:
            with self.client() as client:
                client.readiness()
                list(client.jobs())
        except ClientError:
            return False
        return True

    def submit(self, options: dict[str, object], name: str) -> str:
        with self.client() as client:
            return client.submit(self.capture, preset="draft", config=options, name=name).id

    def begin(self, idle: bool = False) -> None:
        """Submit both jobs, and wait until the first has trained for a while, unless `idle`."""
        self.job, self.behind = self.submit(TRAINING, "training"), self.submit(BRIEF, "behind")
        if not idle:
            self.reach(FAULT_AT)

    @property
    def folder(self) -> JobFolder:
        """The files of the training."""
        return JobFolder(self.data / "jobs" / self.job)

    def iteration(self) -> int:
        """The newest iteration that the trainer reported."""
        report = last_progress(self.folder.progress)
        return 0 if report is None else report.iteration

    def reach(self, iteration: int) -> None:
        """Wait for a checkpoint of at least this iteration."""
        self.until(lambda: (self.folder.checkpoint() or 0) >= iteration, f"a checkpoint of iteration {iteration}")

    def until(self, condition: Callable[[], object], what: str, limit_s: float = LONG_S) -> None:
        deadline = time.monotonic() + limit_s
        while not condition():
            if time.monotonic() > deadline:
                raise Stuck(f"not within {limit_s:g} s: {what}")
            time.sleep(0.1)

    def job_now(self, job_id: str) -> RemoteJob | None:
        """A job as the API shows it; None while the API or its database does not answer."""
        try:
            with self.client() as client:
                return client.job(job_id)
        except ClientError:
            return None

    def ended(self, job_id: str) -> bool:
        """Whether a job has ended; one that failed is retried once, as its owner would when the cause is gone."""
        job = self.job_now(job_id)
        if job is not None and job.state in ("failed", "diverged") and job_id not in self.retried:
            self.notes.append(f"failed with “{job.error}”, retried")
            self.retried.add(job_id)
            with self.client() as client:
                client.retry(job_id)
            return False
        return job is not None and job.ended

    def trainers(self) -> list[int]:
        """Process ids of the trainers of the first job."""
        return processes("jobs.trainer_process", str(self.folder.path))

    def over(self) -> None:
        """The cause of the fault has ended: from here the seconds to recovery are counted."""
        self.over_at, self.over_iteration = time.monotonic(), self.iteration()

    def recovered(self) -> bool:
        """Whether the API answers, and training has gone beyond where it was."""
        return self.answers() and (self.iteration() > self.over_iteration or self.ended(self.job))

    def watch(self, what: str, condition: Callable[[], object]) -> None:
        """Note the seconds from the fault until this happens."""
        self.until(condition, what)
        self.notes.append(f"{what} after {time.monotonic() - self.over_at:.1f} s")

    def kill(self, *pids: int, number: signal.Signals = signal.SIGKILL) -> None:
        for pid in pids:
            os.kill(pid, number)

    def end(self) -> None:
        """Stop everything, also what a fault left behind."""
        started = [*self.workers, *([] if self.api is None else [self.api])]
        for process in started:
            if process.poll() is None:
                process.send_signal(signal.SIGCONT)
                process.terminate()
        for process in started:
            try:
                process.wait(60)
            except subprocess.TimeoutExpired:
                self.notes.append("a process did not end after SIGTERM")
                process.kill()
                process.wait()
        for pid in processes("jobs.trainer_process", str(self.data)):
            self.notes.append("a trainer outlived its worker")
            os.kill(pid, signal.SIGKILL)

    def keep_logs(self, folder: Path) -> None:
        """Copy what the processes and the trainer of the first job have logged."""
        folder.mkdir(parents=True, exist_ok=True)
        for file in (*self.logs.glob("*.log"), self.folder.log, self.folder.path / "attempts.json"):
            shutil.copy(file, folder)


def processes(*words: str) -> list[int]:
    """Ids of the processes whose command line contains all of `words`."""
    found = []
    for folder in Path("/proc").iterdir():
        try:
            command = (folder / "cmdline").read_text() if folder.name.isdigit() else ""
        except (FileNotFoundError, ProcessLookupError):
            continue
        if all(word in command for word in words):
            found.append(int(folder.name))
    return found


@contextmanager
def small_disk(folder: Path, size: str = "24m") -> Iterator[Path]:
    """A file system in memory of a fixed size, mounted at `folder`; needs root."""
    folder.mkdir(parents=True, exist_ok=True)
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", folder], check=True)
    try:
        yield folder
    finally:
        subprocess.run(["umount", "-l", folder], check=True)


@contextmanager
def full(folder: Path) -> Iterator[None]:
    """No space is left on the file system of `folder`."""
    ballast = folder / "ballast"
    with ballast.open("wb", buffering=0) as file:
        try:
            while True:
                file.write(bytes(4096))
        except OSError:
            pass
    try:
        yield
    finally:
        ballast.unlink()
