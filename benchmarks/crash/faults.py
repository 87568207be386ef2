"""The faults: each has a name, what happens, and on which layout of disks and networks it happens."""

from __future__ import annotations

import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from crash.network import Link
from crash.stage import BRIEF, Stage, full

from client import ClientError
from jobs.lease import open_leases
from tests.jobs.postgres_server import Server

STOPPED_S = 40.0  # longer than it takes until PostgreSQL closes the session of a machine that is gone
CUT_S = 60.0
BACK_S = 3_600

# Ten cuts of a checkpoint: file, and what is left of it.
CUTS: tuple[tuple[str, float], ...] = (
    *(("scene.safetensors", left) for left in (0.0, 0.001, 0.5, 0.999)),
    *(("state.safetensors", left) for left in (0.0, 0.001, 0.5, 0.999)),
    *(("checkpoint.json", left) for left in (0.0, 0.5)),
)

NAMED = """
import typer
from jobs import commands, worker
made = worker.Worker.__init__
def named(self, *arguments, **options):
    made(self, *arguments, **options)
    self.id = "same-name"
worker.Worker.__init__ = named
typer.run(commands.worker)
"""
UPGRADED = """
import typer
import graings
from dbos import DBOS
from jobs import commands
graings.__version__ = "99.0"
step = DBOS.step
DBOS.step = lambda *, name, **options: step(name=f"new-{name}", **options)
typer.run(commands.worker)
"""


@dataclass
class Around:
    """What is around a stage: the small disk, the server and the link, if the fault has asked for them."""

    disk: Path | None = None
    server: Server | None = None
    link: Link | None = None
    clock: Path | None = None


def one_worker(stage: Stage, around: Around) -> None:
    stage.start_worker()


def two_workers(stage: Stage, around: Around) -> None:
    stage.start_worker()
    stage.start_worker()


def no_worker(stage: Stage, around: Around) -> None:
    """A worker is started by the fault."""


@dataclass(frozen=True)
class Fault:
    """One row for each backend."""

    name: str
    what: str
    act: Callable[[Stage, Around], None]
    start: Callable[[Stage, Around], None] = one_worker
    backends: tuple[str, ...] = ("sqlite", "postgresql")
    disk: str | None = None  # "data", "database": which of them is on a small disk
    linked: str | None = None  # "server", "worker": which of them is behind a link
    clock: bool = False
    starts_idle: bool = False  # the fault comes before the training
    expects: str = ""


FAULTS: dict[str, Fault] = {}


def fault(name: str, what: str, **how: object) -> Callable[[Callable[[Stage, Around], None]], object]:
    def add(act: Callable[[Stage, Around], None]) -> Callable[[Stage, Around], None]:
        FAULTS[name] = Fault(name, what, act, **how)  # type: ignore[arg-type]
        return act

    return add


def owner(stage: Stage) -> subprocess.Popen[bytes]:
    """The worker that trains the job."""
    holder = stage.folder.attempts()[-1].worker
    return next(worker for worker in stage.workers if f"-{worker.pid}-" in holder)


@fault("none", "nothing")
def nothing(stage: Stage, around: Around) -> None:
    stage.over()


@fault("trainer-kill", "SIGKILL of the trainer")
def trainer_kill(stage: Stage, around: Around) -> None:
    stage.kill(*stage.trainers())
    stage.over()


@fault("trainer-term", "SIGTERM of the trainer")
def trainer_term(stage: Stage, around: Around) -> None:
    stage.kill(*stage.trainers(), number=signal.SIGTERM)
    stage.over()


@fault("trainer-stop", f"SIGSTOP of the trainer for {STOPPED_S:g} s", start=two_workers)
def trainer_stop(stage: Stage, around: Around) -> None:
    pause(stage, stage.trainers())


@fault("worker-kill", "SIGKILL of the worker, another is there", start=two_workers)
def worker_kill(stage: Stage, around: Around) -> None:
    owner(stage).kill()
    stage.over()


@fault("worker-kill-alone", "SIGKILL of the only worker, started again")
def worker_kill_alone(stage: Stage, around: Around) -> None:
    owner(stage).kill()
    stage.over()
    stage.start_worker()


@fault("worker-term", "SIGTERM of the worker, started again")
def worker_term(stage: Stage, around: Around) -> None:
    stage.over()
    owner(stage).terminate()
    owner(stage).wait()
    stage.start_worker()


@fault("worker-stop", f"SIGSTOP of the worker for {STOPPED_S:g} s, another is there", start=two_workers)
def worker_stop(stage: Stage, around: Around) -> None:
    pause(stage, [owner(stage).pid])


@fault("machine-stop", f"SIGSTOP of worker and trainer for {STOPPED_S:g} s, another worker is there", start=two_workers)
def machine_stop(stage: Stage, around: Around) -> None:
    pause(stage, [owner(stage).pid, *stage.trainers()])


def pause(stage: Stage, pids: list[int]) -> None:
    stage.kill(*pids, number=signal.SIGSTOP)
    time.sleep(STOPPED_S)
    stage.kill(*pids, number=signal.SIGCONT)
    stage.over()


@fault("api-kill", "SIGKILL of the API, started again")
def api_kill(stage: Stage, around: Around) -> None:
    stage.api.kill()
    stage.over()
    stage.start_api()


@fault("api-term", "SIGTERM of the API, started again")
def api_term(stage: Stage, around: Around) -> None:
    stage.over()
    stage.api.terminate()
    stage.api.wait()
    stage.start_api()


@fault("all-kill", "SIGKILL of API, worker and trainer, started again")
def all_kill(stage: Stage, around: Around) -> None:
    stage.kill(stage.api.pid, owner(stage).pid, *stage.trainers())
    stage.over()
    stage.start_api()
    stage.start_worker()


@fault("disk-checkpoint", "data folder full for 10 s while a checkpoint is due", disk="data")
def disk_checkpoint(stage: Stage, around: Around) -> None:
    assert around.disk is not None
    with full(around.disk):
        time.sleep(10)
    stage.over()


@fault("disk-upload", "data folder full during an upload", disk="data", start=no_worker, starts_idle=True)
def disk_upload(stage: Stage, around: Around) -> None:
    assert around.disk is not None
    with full(around.disk):
        try:
            stage.submit(BRIEF, "too much")
        except ClientError as error:
            stage.notes.append(f"the upload was refused: {getattr(error, 'status', '')} {error}")
        else:
            raise RuntimeError("an upload was accepted without space for it")
    stage.over()
    stage.start_worker()


@fault("disk-database", "disk of the database full for 20 s", disk="database")
def disk_database(stage: Stage, around: Around) -> None:
    assert around.disk is not None
    with full(around.disk):
        time.sleep(20)  # training ends meanwhile, or another job is to begin
    if around.server is not None:
        around.server.start_if_ended()
    stage.over()


@fault("checkpoint-cut", "all processes killed and the newest checkpoint cut, ten times at other places")
def checkpoint_cut(stage: Stage, around: Around) -> None:
    for number, (name, left) in enumerate(CUTS):
        stage.kill(owner(stage).pid, *stage.trainers())
        stage.until(lambda: not stage.trainers(), "the trainer ended")
        newest = stage.folder.checkpoint()
        cut = stage.folder.run / "checkpoints" / f"{newest:08d}" / name
        with cut.open("r+b") as file:
            file.truncate(int(cut.stat().st_size * left))
        stage.over()
        stage.start_worker()
        if number + 1 < len(CUTS):
            stage.reach((newest or 0) + 1)


@fault("pg-restart", "PostgreSQL restarted, two workers", backends=("postgresql",), start=two_workers)
def pg_restart(stage: Stage, around: Around) -> None:
    assert around.server is not None
    around.server.stop()
    around.server.start()
    stage.over()


@fault("pg-crash", "PostgreSQL crashed (SIGQUIT), back after 10 s", backends=("postgresql",), start=two_workers)
def pg_crash(stage: Stage, around: Around) -> None:
    assert around.server is not None
    around.server.stop(signal.SIGQUIT)
    time.sleep(10)
    around.server.start()
    stage.over()


@fault("pg-cut", f"PostgreSQL cut off for {CUT_S:g} s", backends=("postgresql",), start=two_workers, linked="server")
def pg_cut(stage: Stage, around: Around) -> None:
    assert around.link is not None
    around.link.cut()
    time.sleep(CUT_S)
    around.link.mend()
    stage.over()


@fault("clock-back", "clock of API, worker and trainer set back an hour", clock=True)
def clock_back(stage: Stage, around: Around) -> None:
    assert around.clock is not None
    around.clock.write_text(f"-{BACK_S}\n")
    stage.over()
    stage.kill(*stage.trainers())  # so that what comes next has earlier times than what was before


def same_names(stage: Stage, around: Around) -> None:
    first = stage.start_worker(program=("-c", NAMED))
    stage.until(lambda: any((stage.data / "workers").iterdir()) or "sqlite" not in stage.url, "the first worker")
    time.sleep(5)
    second = stage.start_worker(program=("-c", NAMED))
    stage.notes.append(f"the second ended with code {second.wait(60)}")
    if first.poll() is not None or second.returncode != 1:
        raise RuntimeError("a second worker with the same name was not refused")


@fault("same-name", "two workers with one name; the one that works killed and started again", start=same_names)
def same_name(stage: Stage, around: Around) -> None:
    stage.workers[0].kill()
    stage.over()
    stage.workers[0].wait()
    stage.until(lambda: stage.start_worker(program=("-c", NAMED)).poll() is None, "the name is free")


@fault("worker-upgrade", "worker killed; one of another version, with other steps of the workflow, started")
def worker_upgrade(stage: Stage, around: Around) -> None:
    owner(stage).kill()
    stage.over()
    stage.start_worker(program=("-c", UPGRADED))


def three_machines(stage: Stage, around: Around) -> None:
    assert around.link is not None
    stage.start_worker(prefix=around.link.prefix)
    stage.until(lambda: around_alive(stage) == 1, "the worker behind the link has started")
    stage.late = [stage.start_worker, stage.start_worker]  # the first one takes the job


def around_alive(stage: Stage) -> int:
    leases = open_leases(stage.url, stage.data)
    try:
        return leases.alive()
    finally:
        leases.close()


@fault(
    "machine-gone", "three workers; the machine of the one that trains disappears",
    backends=("postgresql",), start=three_machines, linked="worker",
)  # fmt: skip
def machine_gone(stage: Stage, around: Around) -> None:
    assert around.link is not None
    for start in stage.late:
        start()
    stage.until(lambda: around_alive(stage) == 3, "three workers live")
    around.link.cut()
    stage.kill(stage.workers[0].pid, *stage.trainers())
    stage.over()
    stage.watch("its lease ends", lambda: around_alive(stage) == 2)
    stage.watch("the next attempt begins", lambda: len(stage.folder.attempts()) == 2)


@fault(
    "worker-cut", f"three workers; the one that trains lives on, cut off from PostgreSQL for {CUT_S:g} s",
    backends=("postgresql",), start=three_machines, linked="worker",
)  # fmt: skip
def worker_cut(stage: Stage, around: Around) -> None:
    assert around.link is not None
    for start in stage.late:
        start()
    around.link.cut()
    began = time.monotonic()
    stage.over()
    stage.watch("its lease ends", lambda: around_alive(stage) == 2)
    time.sleep(max(0.0, CUT_S - (time.monotonic() - began)))
    around.link.mend()
    stage.over()


@contextmanager
def faked_clock(folder: Path) -> Iterator[tuple[Path, dict[str, str]]]:
    """A file with the offset of the clock, and the environment of processes whose clock has it."""
    file = folder / "clock"
    file.write_text("+0\n")
    library = next(Path("/usr/lib").glob("*/faketime/libfaketimeMT.so.1"))
    yield (
        file,
        {
            "LD_PRELOAD": str(library),
            "FAKETIME_TIMESTAMP_FILE": str(file),
            "FAKETIME_CACHE_DURATION": "1",
            "FAKETIME_DONT_FAKE_MONOTONIC": "1",
        },
    )
