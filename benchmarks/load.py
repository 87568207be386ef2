"""The service under load: images served and refused, latency of other requests, and memory, by number of clients.

    python benchmarks/load.py RUN [--clients 1 2 8 50 200] [--seconds 20] [--side 400] [--training CAPTURE]

Starts `graings serve` on a temporary data folder with 50 jobs that have ended with the trained model of RUN. Load
comes from `wrk` (a Debian package) with kept connections; each request has its own time and azimuth. Meanwhile one
client each asks for an image, `GET /jobs` and `GET /healthz` again and again, with pauses of 50 ms, and records the
latency of what is served: wrk's own mixes served and refused requests. `--training` also runs a worker with a job on
that capture. `--interpreter` starts the service with another Python, to compare two versions of the code in one run.

wrk and the clients run on the same cores as the service. The table is Markdown; `--json FILE` writes the rows too.
"""

from __future__ import annotations

import argparse
import http.client
import json
import shutil
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

JOBS = 50
PAUSE_S = 0.05
START_S = 60.0
SETTLED_S = 61.0  # after which the service takes the files of a job that has ended for final

LUA = """
local counter = 0
local threads = {}
function setup(thread) counter = counter + 1; thread:set("seed", SEED + counter); table.insert(threads, thread) end
function init() math.randomseed(seed); served, refused, failed = 0, 0, 0 end
function request()
  return wrk.format("GET", string.format("/render?width=SIDE&t=%.7f&azimuth=%.5f", math.random(), 360 * math.random()))
end
function response(status)
  if status == 200 then served = served + 1 elseif status == 503 then refused = refused + 1 else failed = failed + 1 end
end
function done(summary, latency)
  local served, refused, failed = 0, 0, 0
  for _, thread in ipairs(threads) do
    served = served + thread:get("served")
    refused = refused + thread:get("refused")
    failed = failed + thread:get("failed")
  end
  local errors = summary.errors
  failed = failed + errors.connect + errors.read + errors.write + errors.timeout
  io.write(string.format('RESULT {"seconds": %.3f, "served": %d, "refused": %d, "failed": %d}\\n',
    summary.duration / 1e6, served, refused, failed))
end
"""


class Probe(threading.Thread):
    """One client that sends the same request again and again on one connection and records latencies of status 200."""

    def __init__(self, port: int, path: str) -> None:
        super().__init__(daemon=True)
        self._port, self._path = port, path
        self._ended = threading.Event()
        self._first = time.time_ns() % 10**9
        self.latencies: list[float] = []
        self.refused = 0

    def run(self) -> None:
        """Send until `end` is called."""
        connection = http.client.HTTPConnection("127.0.0.1", self._port, timeout=60)
        number = 0
        while not self._ended.wait(PAUSE_S):
            number += 1
            started = time.perf_counter()
            connection.request("GET", self._path.replace("NUMBER", str(self._first + number)))
            response = connection.getresponse()
            response.read()
            if response.status == 200:
                self.latencies.append(time.perf_counter() - started)
            else:
                self.refused += 1

    def end(self) -> dict[str, float | None]:
        """Median and 99th percentile in ms, and how many were served and refused."""
        self._ended.set()
        self.join()
        ms = 1e3 * np.array(self.latencies or [np.nan])
        p50, p99 = (None if np.isnan(v) else round(float(v), 1) for v in np.percentile(ms, [50, 99]))
        return {"p50_ms": p50, "p99_ms": p99, "served": len(self.latencies), "refused": self.refused}


def data_folder(folder: Path, run: Path, python: str) -> None:
    """50 jobs that have ended with the files of `run`, made by the service's own queue in the given interpreter."""
    code = (
        "import os, pathlib, shutil, sys, time\n"
        "from graings.config import make_config\nfrom jobs.commands import default_database\n"
        "from jobs.engine import Engine\nfrom jobs.job import JobSpec\nfrom jobs.queue import JobQueue\n"
        "from jobs.store import Store\n"
        "root, run, count = sys.argv[1:]\nstore = Store(pathlib.Path(root))\n"
        "engine = Engine(default_database(store.root))\nqueue = JobQueue(store, engine)\n"
        "config = make_config('draft').model_dump(mode='json')\n"
        "for n in range(int(count)):\n"
        "    unpacked = store.uploads / 'u'\n    unpacked.mkdir()\n    (unpacked / 'a').touch()\n"
        "    job = queue.submit(JobSpec(name=f'job {n}', capture='0' * 64, config=config), unpacked).id\n"
        "    job_folder = store.folder(job)\n    job_folder.end_attempt(job_folder.begin_attempt('worker'), 0)\n"
        "    shutil.copytree(run, job_folder.run)\n    engine.cancel(job)\n"
        "engine.close()\n"
    )
    subprocess.run([python, "-c", code, folder, run, str(JOBS)], check=True)
    time.sleep(SETTLED_S)


@contextmanager
def serving(folder: Path, python: str, with_worker: bool) -> Iterator[tuple[int, int]]:
    """The service as a process; yields its port and process id."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = int(probe.getsockname()[1])
    command = [python, "-m", "service.commands", "--data", str(folder), "--port", str(port)]
    if with_worker:
        command.append("--with-worker")
    with (folder / "service.log").open("wb") as log:
        process = subprocess.Popen(command, stdout=log, stderr=log)
    try:
        deadline = time.monotonic() + START_S
        while True:
            try:
                get(port, "/readyz")
                break
            except OSError:
                if time.monotonic() > deadline or process.poll() is not None:
                    raise
                time.sleep(0.2)
        yield port, process.pid
    finally:
        process.terminate()
        process.wait()


def get(port: int, path: str) -> tuple[int, bytes]:
    """Status and body of one request."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=120)
    connection.request("GET", path)
    response = connection.getresponse()
    return response.status, response.read()


def resident_mb(pid: int) -> float:
    """Resident memory of a process in MB."""
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith("VmRSS:"):
            return int(line.split()[1]) * 1024 / 1e6
    raise RuntimeError(f"/proc/{pid}/status has no VmRSS")


def measure(port: int, pid: int, clients: int, seconds: int, side: int) -> dict[str, Any]:
    """One row of the table. No image is asked for twice, so that none is a kept one."""
    probes = {
        "render": Probe(port, f"/render?width={side}&t=0.5&azimuth=0.NUMBER"),
        "jobs": Probe(port, "/jobs"),
        "healthz": Probe(port, "/healthz"),
    }
    for probe in probes.values():
        probe.start()
    script = LUA.replace("SIDE", str(side)).replace("SEED", str(time.time_ns() % 10**9))
    command = ["wrk", "-t", str(min(2, clients)), "-c", str(clients), "-d", f"{seconds}s", "--timeout", "60s"]
    with tempfile.NamedTemporaryFile("w", suffix=".lua") as file:
        file.write(script)
        file.flush()
        command += ["-s", file.name, f"http://127.0.0.1:{port}"]
        output = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    result = json.loads(next(line for line in output.splitlines() if line.startswith("RESULT")).removeprefix("RESULT "))
    row = {"clients": clients, **result, **{name: probe.end() for name, probe in probes.items()}}
    row["served_per_s"] = round(result["served"] / result["seconds"], 1)
    row["refused_per_s"] = round(result["refused"] / result["seconds"], 1)
    row["memory_mb"] = round(resident_mb(pid))
    return row


def table(rows: list[dict[str, Any]]) -> str:
    """The rows as Markdown."""
    lines = [
        "| clients | images/s | refused/s | failed | image p50, p99 ms | /jobs p50, p99 | /healthz p50, p99 | MB |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        latency = [f"{row[name]['p50_ms']}, {row[name]['p99_ms']}" for name in ("render", "jobs", "healthz")]
        cells = [row["clients"], row["served_per_s"], row["refused_per_s"], row["failed"], *latency, row["memory_mb"]]
        lines.append(f"| {' | '.join(map(str, cells))} |")
    return "\n".join(lines)


def submit(port: int, capture: Path) -> None:
    """Submit a long training job on `capture` and wait until it trains."""
    with tempfile.TemporaryDirectory() as folder:
        archive = Path(shutil.make_archive(str(Path(folder) / "capture"), "tar", capture))
        connection = http.client.HTTPConnection("127.0.0.1", port, timeout=300)
        connection.request("POST", "/jobs?preset=fine&priority=1", archive.read_bytes())
        response = connection.getresponse()
        job = json.loads(response.read())
        if response.status != 202:
            raise RuntimeError(f"the job was refused: {job}")
    while not (progress := json.loads(get(port, f"/jobs/{job['id']}")[1])["progress"]) or progress["iteration"] < 50:
        time.sleep(1.0)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--clients", type=int, nargs="+", default=[1, 2, 8, 50, 200])
    parser.add_argument("--seconds", type=int, default=20)
    parser.add_argument("--side", type=int, default=400)
    parser.add_argument("--training", type=Path, metavar="CAPTURE")
    parser.add_argument("--interpreter", default=sys.executable)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    rows = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        data_folder(folder, arguments.run, arguments.interpreter)
        with serving(folder, arguments.interpreter, arguments.training is not None) as (port, pid):
            print(f"memory at rest: {resident_mb(pid):.0f} MB", flush=True)
            if arguments.training is not None:
                submit(port, arguments.training)
            status, body = get(port, f"/render?width={arguments.side}&t=0.5")
            if status != 200:
                raise RuntimeError(f"GET /render: {body.decode()}")
            for clients in arguments.clients:
                rows.append(measure(port, pid, clients, arguments.seconds, arguments.side))
                print(table(rows).splitlines()[-1], flush=True)
    print("\n" + table(rows))
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
