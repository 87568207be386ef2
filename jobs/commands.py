"""The command `worker`; also `python -m jobs.commands`."""

from __future__ import annotations

import os
import signal
import sys
import threading
from pathlib import Path
from typing import Annotated

import typer

from jobs.job import JobError
from jobs.logs import log_to_stderr
from jobs.parent import watch_parent
from jobs.store import Store
from jobs.worker import Worker

DATABASE_FILE = "jobs.sqlite"

# A training may take all cores for hours; an image or a page beside it should not wait for it.
TRAINING_NICE = 10


def default_database(data: Path) -> str:
    """The URL of the SQLite database in the data folder, which must be on a local disk."""
    return f"sqlite:///{data.resolve() / DATABASE_FILE}"


def worker(
    data: Annotated[Path, typer.Option(envvar="GRAINGS_DATA", help="Folder with captures and jobs.")] = Path("data"),
    database: Annotated[
        str | None,
        typer.Option(
            envvar="GRAINGS_DATABASE", help="sqlite:///… or postgresql://… (default: SQLite in the data folder)."
        ),
    ] = None,
    slots: Annotated[
        int, typer.Option(min=1, max=64, help="Jobs at a time; the last worker to start sets it for all workers.")
    ] = 1,
    threads: Annotated[
        int | None, typer.Option(min=1, max=256, help="CPU threads per job (default: all cores / slots).")
    ] = None,
    nice: Annotated[
        int,
        typer.Option(
            envvar="GRAINGS_NICE", min=0, max=19, help="Lower the priority of trainings on the CPU by so much."
        ),
    ] = TRAINING_NICE,
    exit_with_parent: Annotated[
        bool, typer.Option("--exit-with-parent", help="Stop when standard input ends.")
    ] = False,
) -> None:
    """Take training jobs from the queue until interrupted, then stop the running jobs at a checkpoint."""
    log_to_stderr()
    stop = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stop.set())
    if exit_with_parent:
        watch_parent(stop.set)
    store = Store(data)
    # macOS cannot limit a process to some cores.
    cores = len(os.sched_getaffinity(0)) if sys.platform == "linux" else os.cpu_count() or 1
    job_threads = threads or max(1, cores // slots)
    try:
        url = database or default_database(store.root)
        Worker(store, url, slots=slots, threads=job_threads, nice=nice).run(stop)
    except JobError as error:
        typer.echo(f"worker: {error}", err=True)
        raise typer.Exit(1) from error


if __name__ == "__main__":
    typer.run(worker)
