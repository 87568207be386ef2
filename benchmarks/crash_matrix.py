"""The crash matrix: every fault on every backend, with the real processes of API, workers and trainers.

    python benchmarks/crash_matrix.py [--faults trainer-kill disk-database] [--backends sqlite] [--json FILE]
    python benchmarks/crash_matrix.py --merge FILE FILE --markdown FILE

Each row is a service of its own: two jobs are submitted over HTTP, the fault comes while the first trains, and when its
cause is gone both jobs must end, neither lost nor trained twice at once, with the model of an undisturbed training to
the bit. PostgreSQL is started for it, if it is installed. Full disks and machines that disappear need root (a small
file system in memory, a network of its own), the clock needs libfaketime.
"""

from __future__ import annotations

import argparse
import shlex
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))  # the tests have the server

from crash import network
from crash.faults import FAULTS, Around, Fault, faked_clock
from crash.rows import Matrix, Row, digest, table, trained_twice
from crash.stage import Stage, Stuck, small_disk

from client import ClientError
from graings.capture.synthetic import write_synthetic
from graings.report.machine import machine_facts, version_facts
from tests.jobs.postgres_server import is_installed, running

SIZE = 32


def unavailable(fault: Fault, backend: str) -> str | None:
    """Why the fault cannot be tried here; None if it can."""
    if backend == "postgresql" and not is_installed():
        return "PostgreSQL is not installed"
    if fault.clock and not list(Path("/usr/lib").glob("*/faketime/libfaketimeMT.so.1")):
        return "libfaketime is not installed"
    return network.unavailable() if fault.linked or fault.disk else None


@contextmanager
def prepared(fault: Fault, backend: str, capture: Path, stack: ExitStack) -> Iterator[tuple[Stage, Around]]:
    """A stage with the disks, networks and clocks of the fault, and nothing started on it."""
    folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="graings-crash-")))
    folder.chmod(0o755)  # PostgreSQL runs as another user
    around = Around()
    data = folder / "data"
    if fault.disk == "data":
        around.disk = stack.enter_context(small_disk(data))
    elif fault.disk == "database":
        around.disk = stack.enter_context(small_disk(folder / "disk", "24m" if backend == "sqlite" else "160m"))
    if fault.linked:
        around.link = stack.enter_context(network.link())
    url = f"sqlite:///{around.disk or data}/jobs.sqlite"
    if backend == "postgresql":
        host = {"server": network.THERE, "worker": network.HERE, None: "127.0.0.1"}[fault.linked]
        prefix = network.Link.prefix if fault.linked == "server" else ()
        place = around.disk if fault.disk == "database" else None
        around.server = stack.enter_context(running(host, prefix, place))
        url = around.server.url
    data.mkdir(exist_ok=True)
    stage = Stage(data, folder, url, capture)
    if fault.clock:
        around.clock, environment = stack.enter_context(faked_clock(folder))
        stage.environment |= environment
    try:
        yield stage, around
    finally:
        stage.end()


def run(fault: Fault, backend: str, capture: Path, expected: str | None, logs: Path | None) -> tuple[Row, str]:
    """One row, and the digest of the model."""
    facts = {"fault": fault.name, "what": fault.what, "backend": backend}
    if (reason := unavailable(fault, backend)) is not None:
        return Row(**facts, skipped=reason), ""
    began, stuck, recovery_s = time.monotonic(), None, None
    with ExitStack() as stack, prepared(fault, backend, capture, stack) as (stage, around):
        try:
            stage.start_api()
            fault.start(stage, around)
            stage.begin(idle=fault.starts_idle)
            fault.act(stage, around)
            stage.until(stage.recovered, "training goes on")
            recovery_s = round(time.monotonic() - stage.over_at, 1)
            for job_id in (stage.job, stage.behind):
                stage.until(lambda job_id=job_id: stage.ended(job_id), "the job ends")
        except (Stuck, RuntimeError, ClientError) as error:
            stuck = str(error)
        if not stage.behind:
            return Row(**facts, stuck=stuck, notes=("the fault could not be tried",)), ""
        jobs = [stage.job_now(job_id) for job_id in (stage.job, stage.behind)]
        stage.end()
        found = digest(stage)
        row = Row(
            **facts,
            stuck=stuck,
            lost=sum(job is None or job.state != "succeeded" for job in jobs),
            twice=trained_twice(stage),
            equal=expected is None or found == expected,
            attempts=len(stage.folder.attempts()),
            recovery_s=recovery_s,
            total_s=round(time.monotonic() - began, 1),
            notes=tuple(stage.notes),
        )
        if logs is not None and not row.passed:
            stage.keep_logs(logs / f"{fault.name}-{backend}")
    return row, found


def write(parts: list[Matrix], file: Path | None) -> None:
    """The table of all parts as Markdown: of rows of the same fault and backend the last one."""
    rows = {(row.fault, row.backend): row for part in parts for row in part.rows}
    ordered = sorted(rows.values(), key=lambda row: list(FAULTS).index(row.fault))
    origins = [f"`{part.command}`, commit {part.commit}, {part.machine}" for part in parts]
    if file is not None:
        file.write_text("\n".join([*(f"- {origin}" for origin in origins), "", table(ordered), ""]))


def main() -> None:
    """Try the faults and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--faults", nargs="+", choices=list(FAULTS), default=list(FAULTS), metavar="FAULT")
    parser.add_argument("--backends", nargs="+", choices=["sqlite", "postgresql"], default=["sqlite", "postgresql"])
    parser.add_argument("--json", type=Path, help="write the rows to this file, after each row")
    parser.add_argument("--markdown", type=Path, help="write the table to this file")
    parser.add_argument("--logs", type=Path, help="keep the logs of rows with a defect in this folder")
    parser.add_argument("--merge", nargs="+", type=Path, help="try nothing: join the rows of these files")
    arguments = parser.parse_args()
    if arguments.merge:
        parts = [Matrix.model_validate_json(file.read_text()) for file in arguments.merge]
        write(parts, arguments.markdown)
        return
    names = ["none", *(name for name in arguments.faults if name != "none")]
    rows: list[Row] = []
    expected: str | None = None
    command = f"python benchmarks/crash_matrix.py {shlex.join(sys.argv[1:])}".strip()
    machine = machine_facts(1)
    with tempfile.TemporaryDirectory() as folder:
        capture = write_synthetic(Path(folder) / "capture", frames=6, size=SIZE)
        for name in names:
            fault = FAULTS[name]
            for backend in arguments.backends:
                if backend not in fault.backends:
                    continue
                row, found = run(fault, backend, capture, expected, arguments.logs)
                expected = expected or found
                rows.append(row)
                print(table([row]).splitlines()[-1], flush=True)
                matrix = Matrix(
                    command=command,
                    commit=version_facts().commit,
                    machine=f"{machine.cpu}, {machine.usable_cores} cores",
                    rows=tuple(rows),
                )
                if arguments.json is not None:
                    arguments.json.write_text(matrix.model_dump_json(indent=1))
    write([matrix], arguments.markdown)
    defects = sum(not row.passed and row.skipped is None for row in rows)
    print(f"{len(rows)} rows, {defects} with a defect")
    sys.exit(1 if defects else 0)


if __name__ == "__main__":
    main()
