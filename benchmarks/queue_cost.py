"""What the queue costs: 1,000 jobs whose child process only sleeps, on SQLite and on PostgreSQL, and idle workers.

    python benchmarks/queue_cost.py [--jobs 1000] [--slots 1 8] [--backends sqlite postgresql] [--idle 1 4]
        [--json FILE]

The worker is the real one, with real child processes, leases and records; only the module that a child runs is another:
it sleeps for 30 ms instead of training, which with the start of its interpreter makes some 50 ms. What such a child
takes without a queue is measured in the same run. A worker asks the queue every half second, so that with one slot the
wait for the next question is most of the time; with many slots the cost of the queue itself shows. For PostgreSQL,
which is started for it, `--idle` counts the connections and transactions of so many workers without work.
"""

from __future__ import annotations

import argparse
import asyncio
import resource
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import ExitStack
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))  # the tests have the server

import psycopg
from pydantic import Field

from graings.config import make_config
from graings.document import Document
from jobs.child_process import ChildProcess
from jobs.commands import default_database
from jobs.engine import Engine
from jobs.job import JobSpec, JobState
from jobs.queue import JobQueue
from jobs.store import JobFolder, Store
from jobs.worker import Worker
from tests.jobs.postgres_server import Server, running

CHILD = ("timeit", "-n", "1", "-r", "1", "import time; time.sleep(0.03)")
ALONE = 30  # children without a queue
IDLE_S = 20.0


class Row(Document):
    """One backend with one number of slots."""

    backend: str
    slots: int
    jobs: int
    child_ms: float = Field(description="Mean time of one child without a queue.")
    submit_ms: float = Field(description="Time to store and enqueue one job.")
    wall_ms: float = Field(description="Time until all jobs had ended, for each.")
    worker_cpu_ms: float = Field(description="CPU time of the worker without its children, for each job.")
    list_ms: float = Field(description="Time for the first page of 50 jobs, when all have ended.")
    database_mb: float = Field(description="Growth of the database.")
    folder_kb: float = Field(description="Disk that the folder of one job takes.")


class IdleRow(Document):
    """So many workers without work."""

    workers: int
    connections: int
    transactions_per_s: float


class SleepingWorker(Worker):
    """The worker, with a child that only sleeps."""

    def _child(self, module: str, folder: JobFolder, *arguments: str) -> ChildProcess:
        return ChildProcess(CHILD, folder.log)


async def alone(log: Path) -> float:
    """Mean time of one child without a queue, in ms."""
    started = time.perf_counter()
    for _ in range(ALONE):
        await ChildProcess(CHILD, log).run()
    return 1e3 * (time.perf_counter() - started) / ALONE


def database_bytes(url: str) -> int:
    """Size of the database, its write-ahead log included for SQLite."""
    if url.startswith("sqlite"):
        file = Path(url.removeprefix("sqlite:///"))
        return sum(path.stat().st_size for path in file.parent.glob(f"{file.name}*"))
    with psycopg.connect(url) as connection:
        row = connection.execute("select pg_database_size(current_database())").fetchone()
    assert row is not None
    return int(row[0])


def measure(backend: str, url: str, folder: Path, slots: int, jobs: int) -> Row:
    """One row."""
    store = Store(folder / "data")
    engine = Engine(url)
    queue = JobQueue(store, engine)
    before = database_bytes(url)
    spec = JobSpec("sleep", "0" * 64, make_config("draft").model_dump(mode="json"))
    (unpacked := store.uploads / "capture").mkdir()
    (unpacked / "a").touch()
    started = time.perf_counter()
    ids = [queue.submit(spec, unpacked).id]
    ids += [queue.submit(spec, None).id for _ in range(jobs - 1)]
    submit_ms = 1e3 * (time.perf_counter() - started) / jobs
    child_ms = asyncio.run(alone(folder / "log"))

    worker, stop = SleepingWorker(store, url, slots=slots), threading.Event()
    thread = threading.Thread(target=worker.run, args=(stop,))
    cpu, started = cpu_s(), time.perf_counter()
    thread.start()
    while engine.waiting() or engine.running():
        time.sleep(1.0)
    wall_ms, cpu_ms = 1e3 * (time.perf_counter() - started) / jobs, 1e3 * (cpu_s() - cpu) / jobs
    stop.set()
    thread.join()

    started = time.perf_counter()
    page, _ = queue.page(50)
    list_ms = 1e3 * (time.perf_counter() - started)
    assert len(page) == min(50, jobs)
    others = [entry for entry in engine.entries(ids).values() if entry.state is not JobState.SUCCEEDED]
    if others:
        raise RuntimeError(f"{len(others)} of {jobs} jobs did not succeed, as {others[0]}")
    engine.close()
    sizes = subprocess.run(["du", "-sk", store.folder(ids[0]).path], check=True, capture_output=True, text=True)
    return Row(
        backend=backend,
        slots=slots,
        jobs=jobs,
        child_ms=round(child_ms, 1),
        submit_ms=round(submit_ms, 1),
        wall_ms=round(wall_ms, 1),
        worker_cpu_ms=round(cpu_ms, 1),
        list_ms=round(list_ms, 1),
        database_mb=round((database_bytes(url) - before) / 1e6, 2),
        folder_kb=float(sizes.stdout.split()[0]),
    )


def cpu_s() -> float:
    """CPU time of this process, in seconds."""
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return usage.ru_utime + usage.ru_stime


def idle(server: Server, folder: Path, workers: int) -> IdleRow:
    """Connections and transactions of workers that wait for jobs."""
    command = [sys.executable, "-m", "jobs.commands", "--data", str(folder / "data"), "--database", server.url]
    processes = [subprocess.Popen(command) for _ in range(workers)]
    others = "from pg_stat_activity where datname = current_database() and pid <> pg_backend_pid()"
    try:
        with psycopg.connect(server.url, autocommit=True) as connection:

            def value(query: bytes) -> int:
                row = connection.execute(query).fetchone()
                assert row is not None
                return int(row[0])

            locks = b"select count(*) from pg_locks where locktype = 'advisory'"
            while value(locks) < workers:
                time.sleep(0.5)
            time.sleep(5.0)
            done = b"select xact_commit + xact_rollback from pg_stat_database where datname = current_database()"
            first, began = value(done), time.monotonic()
            time.sleep(IDLE_S)
            rate = (value(done) - first) / (time.monotonic() - began)
            return IdleRow(
                workers=workers,
                connections=value(f"select count(*) {others}".encode()),
                transactions_per_s=round(rate, 1),
            )
    finally:
        for process in processes:
            process.terminate()
        for process in processes:
            process.wait()


def table(rows: list[Row]) -> str:
    """The rows as Markdown."""
    lines = [
        "| backend | slots | jobs | child alone | submit | until ended, each | worker's CPU, each | page of 50 | "
        "database | folder of a job |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        times = (row.child_ms, row.submit_ms, row.wall_ms, row.worker_cpu_ms, row.list_ms)
        cells = [row.backend, row.slots, row.jobs, *(f"{value:g} ms" for value in times)]
        lines.append(f"| {' | '.join(map(str, [*cells, f'{row.database_mb:g} MB', f'{row.folder_kb:g} kB']))} |")
    return "\n".join(lines)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--jobs", type=int, default=1_000)
    parser.add_argument("--slots", type=int, nargs="+", default=[8])
    parser.add_argument("--backends", nargs="+", choices=["sqlite", "postgresql"], default=["sqlite", "postgresql"])
    parser.add_argument("--idle", type=int, nargs="*", default=[1, 4], help="numbers of workers without work")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    rows: list[Row] = []
    idle_rows: list[IdleRow] = []
    for backend in arguments.backends:
        for slots in arguments.slots:
            with ExitStack() as stack:
                folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="graings-queue-")))
                server = stack.enter_context(running()) if backend == "postgresql" else None
                url = default_database(folder) if server is None else server.url
                rows.append(measure(backend, url, folder, slots, arguments.jobs))
                print(table(rows[-1:]).splitlines()[-1], flush=True)
                if server is not None and slots == arguments.slots[-1]:
                    for workers in arguments.idle:
                        idle_rows.append(idle(server, folder, workers))
                        print(idle_rows[-1].model_dump_json(), flush=True)
    print("\n" + table(rows))
    if arguments.json is not None:
        arguments.json.write_text("[" + ",\n".join(row.model_dump_json() for row in (*rows, *idle_rows)) + "]\n")


if __name__ == "__main__":
    main()
