"""A soak test: clients that look at scenes and train for minutes, and what that does to latency, memory and files.

    python benchmarks/soak.py -o FOLDER [--minutes 20] [--clients 20] [--pause 0.2] [--side 128]

Starts `graings serve --with-worker` on a temporary data folder and trains one model. Then two of the clients submit
short trainings, wait for their end and delete them, two list jobs and read the numbers of one, and all others ask for
images, each of its own time and direction, with short pauses. Every window of the run has a row: requests, errors,
refusals (503 with Retry-After, which clients repeat), median and 99th percentile of the latency of images, resident
memory and open files of the service and of its worker. FOLDER gets soak.json, soak.md and soak.svg.
"""

from __future__ import annotations

import argparse
import random
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from load import resident_mb, serving
from pydantic import Field

from client import Client, ClientError
from graings.capture.synthetic import write_synthetic
from graings.document import Document
from graings.report.axes import LINE_COLORS, new_page, new_panel
from graings.report.figure_files import INK, style, svg
from graings.report.machine import machine_facts, version_facts

TRAINING = {"iterations": 60, "init.points": 200, "evaluation.views": 1}
WINDOWS = 30  # rows of a run
TRAINERS, LISTERS = 2, 2


class Window(Document):
    """A part of the run."""

    end_s: float = Field(description="Seconds from the start to the end of the window.")
    requests: int
    images: int
    trainings: int = Field(description="Trainings that succeeded.")
    errors: int
    refused: int
    p50_ms: float | None
    p99_ms: float | None
    api_mb: float
    api_files: int
    worker_mb: float
    worker_files: int


class Soak(Document):
    """A whole run."""

    command: str
    commit: str | None
    machine: str
    minutes: float
    clients: int
    errors: tuple[str, ...] = Field(description="The first errors, as text.")
    windows: tuple[Window, ...]


class Tally:
    """What all clients have counted since the last window. Thread-safe."""

    def __init__(self) -> None:
        self._guard = threading.Lock()
        self.errors: list[str] = []
        self._clear()

    def _clear(self) -> None:
        self._counts = dict.fromkeys(("requests", "images", "trainings", "errors", "refused"), 0)
        self._latencies: list[float] = []

    def add(self, kind: str) -> None:
        with self._guard:
            self._counts[kind] += 1

    def image(self, seconds: float) -> None:
        with self._guard:
            self._counts["images"] += 1
            self._latencies.append(seconds)

    def error(self, text: str) -> None:
        with self._guard:
            self._counts["errors"] += 1
            self.errors.append(text)

    def window(self) -> dict[str, float | None]:
        """The counts, which start again from zero."""
        with self._guard:
            counts, latencies = self._counts, self._latencies
            self._clear()
        ms = [round(1e3 * float(v), 1) for v in np.percentile(latencies, [50, 99])] if latencies else [None, None]
        return {**counts, "p50_ms": ms[0], "p99_ms": ms[1]}


def looks(client: Client, tally: Tally, job: str, side: int, chance: random.Random) -> None:
    """One image."""
    started = time.perf_counter()
    content = client.render(job, t=chance.random(), azimuth=360 * chance.random(), width=side)
    if not content:
        raise ClientError("an empty image")
    tally.image(time.perf_counter() - started)


def lists(client: Client, tally: Tally, job: str) -> None:
    """The jobs, and one of them."""
    list(client.jobs())
    if client.job(job).state != "succeeded":
        raise ClientError(f"job {job} is not there any more")


def trains(client: Client, tally: Tally, capture: Path) -> None:
    """A short training, deleted afterwards."""
    job = client.wait(client.submit(capture, preset="draft", config=TRAINING).id)
    if job.state != "succeeded":
        raise ClientError(f"a training {job.state}: {job.error}")
    client.delete(job.id)
    tally.add("trainings")


def keep_asking(port: int, ask: Callable[[Client], None], tally: Tally, ended: threading.Event, pause_s: float) -> None:
    """One client: asks until the run has ended."""

    def refused(response: object) -> None:
        tally.add("requests")
        if getattr(response, "status_code", 0) == 503:
            tally.add("refused")

    with Client(f"http://127.0.0.1:{port}", timeout=120.0, event_hooks={"response": [refused]}) as client:
        while not ended.wait(pause_s):
            try:
                ask(client)
            except ClientError as error:
                tally.error(str(error))


def open_files(pid: int) -> int:
    """How many files and sockets a process has open."""
    return len(list(Path(f"/proc/{pid}/fd").iterdir()))


def worker_of(pid: int) -> int:
    """Process id of the worker that the service has started."""
    found = subprocess.run(["pgrep", "-P", str(pid), "-f", "jobs.commands"], check=True, capture_output=True, text=True)
    return int(found.stdout.split()[0])


@style()
def figure(soak: Soak) -> str:
    """Latency, memory and open files over time, as SVG."""
    page_figure, page = new_page(960, 760, f"Soak: {soak.clients} clients, {soak.minutes:g} min")
    minutes = [window.end_s / 60 for window in soak.windows]
    panels = [
        ("latency of an image, ms", {"p99": "p99_ms", "p50": "p50_ms"}),
        ("memory, MB", {"service": "api_mb", "worker": "worker_mb"}),
        ("open files", {"service": "api_files", "worker": "worker_files"}),
    ]
    for index, (name, lines) in enumerate(panels):
        top = 70 + 230 * index
        axes = new_panel(page_figure, 78, 880, top + 24, top + 190)
        page.text(24, top + 8, name, color=INK)
        for color, (label, field) in zip(LINE_COLORS, lines.items(), strict=False):
            values = [getattr(window, field) for window in soak.windows]
            known = [float("nan") if value is None else value for value in values]
            axes.plot(minutes, known, color=color)
            axes.annotate(label, (minutes[-1], known[-1]), (6, 0), textcoords="offset points", color=color, va="center")
        axes.set_ylim(bottom=0)
        axes.set_xlim(0, minutes[-1])
    axes.set_xlabel("minutes")
    return svg(page_figure)


def table(soak: Soak) -> str:
    """Five of the rows as Markdown, and the sums."""
    windows = soak.windows
    lines = [
        "| until | images | trainings | errors | refused | p50 | p99 | service | its files | worker | its files |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for i in sorted({round(j * (len(windows) - 1) / 4) for j in range(5)}):
        w = windows[i]
        counts = (w.images, w.trainings, w.errors, w.refused)
        sizes = (f"{w.api_mb:.0f} MB", w.api_files, f"{w.worker_mb:.0f} MB", w.worker_files)
        cells = (f"{w.end_s / 60:.1f} min", *counts, f"{w.p50_ms} ms", f"{w.p99_ms} ms", *sizes)
        lines.append(f"| {' | '.join(map(str, cells))} |")
    sums = ", ".join(
        f"{sum(getattr(w, name) for w in windows)} {name}"
        for name in ("requests", "images", "trainings", "errors", "refused")
    )
    return "\n".join([*lines, "", f"In all: {sums}."])


def main() -> None:
    """Run and write the files."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--minutes", type=float, default=20.0)
    parser.add_argument("--clients", type=int, default=20)
    parser.add_argument("--pause", type=float, default=0.2, help="seconds between the requests of a client")
    parser.add_argument("--side", type=int, default=128)
    arguments = parser.parse_args()
    arguments.output.mkdir(parents=True, exist_ok=True)
    tally, ended = Tally(), threading.Event()
    windows: list[Window] = []
    with tempfile.TemporaryDirectory(prefix="graings-soak-") as name:
        capture = write_synthetic(Path(name) / "capture", frames=6, size=32)
        (data := Path(name) / "data").mkdir()
        with serving(data, sys.executable, with_worker=True) as (port, pid):
            with Client(f"http://127.0.0.1:{port}", timeout=120.0) as client:
                job = client.wait(client.submit(capture, preset="draft", config=TRAINING, name="scene").id).id
            asks: list[Callable[[Client], None]] = [lambda client: trains(client, tally, capture)] * TRAINERS
            asks += [lambda client: lists(client, tally, job)] * LISTERS
            for seed in range(arguments.clients - len(asks)):
                chance = random.Random(seed)
                asks.append(lambda client, chance=chance: looks(client, tally, job, arguments.side, chance))
            threads = [
                threading.Thread(target=keep_asking, args=(port, ask, tally, ended, arguments.pause)) for ask in asks
            ]
            for thread in threads:
                thread.start()
            began = time.monotonic()
            for number in range(WINDOWS):
                time.sleep(max(0.0, began + 60 * arguments.minutes * (number + 1) / WINDOWS - time.monotonic()))
                worker = worker_of(pid)
                windows.append(
                    Window(
                        end_s=round(time.monotonic() - began, 1),
                        **tally.window(),  # type: ignore[arg-type]
                        api_mb=round(resident_mb(pid), 1),
                        api_files=open_files(pid),
                        worker_mb=round(resident_mb(worker), 1),
                        worker_files=open_files(worker),
                    )
                )
                print(windows[-1].model_dump_json(), flush=True)
            ended.set()
            for thread in threads:
                thread.join()
    machine = machine_facts(1)
    soak = Soak(
        command=f"python benchmarks/soak.py {' '.join(sys.argv[1:])}",
        commit=version_facts().commit,
        machine=f"{machine.cpu}, {machine.usable_cores} cores",
        minutes=arguments.minutes,
        clients=arguments.clients,
        errors=tuple(tally.errors[:10]),
        windows=tuple(windows),
    )
    (arguments.output / "soak.json").write_text(soak.model_dump_json(indent=1) + "\n")
    text = f"`{soak.command}`, commit {soak.commit}, {soak.machine}.\n\n{table(soak)}\n"
    (arguments.output / "soak.md").write_text(text)
    (arguments.output / "soak.svg").write_text(figure(soak))
    print(text, *soak.errors, sep="\n")


if __name__ == "__main__":
    main()
