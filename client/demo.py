"""The command `demo`: train a synthetic moving scene over HTTP and fetch views of it.

It draws the capture and starts the service by their commands, and is then a client like any other: it submits the
capture, shows the progress of training, and fetches views and metrics.
"""

from __future__ import annotations

import json
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from client import Client, ClientError, Event

GRAINGS = [sys.executable, "-m", "graings"]

# About a minute of training on two cores.
PRESET = "draft"
OPTIONS: dict[str, Any] = {"iterations": 800}
SCENE = "walker"
SIZE = 200
VIEWS = 150

TIMES = (0.0, 0.2, 0.4, 0.6, 0.8)
VIEWPOINTS: dict[str, dict[str, object]] = {
    "val0": {"camera": "val:0"},
    "orbit30": {"azimuth": 30, "width": 400, "height": 400},
    "orbit150": {"azimuth": 150, "width": 400, "height": 400},
}
PREFERRED_PORT = 8000
START_S = 60.0


class DemoError(Exception):
    """The demo cannot continue."""


def demo(
    once: Annotated[bool, typer.Option("--once", help="Exit when the views are written.")] = False,
    folder: Annotated[Path, typer.Option(help="Folder for data, views and metrics.")] = Path("data/demo"),
) -> None:
    """Train a small moving scene through the service and show it."""
    console = Console()
    started = time.monotonic()
    serving = False
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        with _service(folder / "service", folder / "service.log") as (url, client):
            job = _train(url, client, folder, console)
            metrics = _fetch(client, job, folder, console)
            console.print(f"Held-out PSNR [bold]{metrics['splits']['val']['psnr']:.2f} dB[/] (validation views)")
            console.print(f"Total time {time.monotonic() - started:.0f} s.")
            if not once:
                console.print(f"Serving at [bold]{url}[/] — drag to orbit, move the time slider. Press Ctrl-C to stop.")
                serving = True
                threading.Event().wait()
    except KeyboardInterrupt:
        # The child processes have ended. It is a failure only if the views are not written yet.
        raise typer.Exit(0 if serving else 130) from None
    except (DemoError, ClientError) as error:
        console.print(f"[red]demo:[/] {error}")
        raise typer.Exit(1) from error


def _train(url: str, client: Client, folder: Path, console: Console) -> str:
    """Submit the capture and wait for the end of the job; returns its id."""
    capture = folder / SCENE
    if not capture.exists():
        with console.status(f"drawing {VIEWS} training images of {SCENE}"):
            _draw_capture(capture)
    console.print(f"Capture: {capture} ({VIEWS} training images of {SIZE} px)")
    job = client.submit(capture, preset=PRESET, config=OPTIONS)
    console.print(f"Job:     {url}/jobs/{job.id}")
    columns = (
        TextColumn("{task.fields[phase]:>8}"),
        BarColumn(),
        TextColumn("{task.completed:.0f}/{task.total:.0f}"),
        TextColumn("{task.fields[details]}"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console) as progress:
        bar = progress.add_task("train", total=OPTIONS["iterations"], phase="waiting", details="")

        def show(event: Event) -> None:
            if event.kind == "progress":
                report, details = event.data, ""
                if report["psnr"] is not None:
                    details = f"{report['psnr']:.1f} dB · {report['gaussians']} Gaussians"
                progress.update(bar, completed=report["iteration"], phase=report["phase"], details=details)

        job = client.wait(job.id, show)
    if job.state != "succeeded":
        raise DemoError(f"the job has {job.state}: {job.error}. Its log: {url}/jobs/{job.id}/log")
    return job.id


def _draw_capture(capture: Path) -> None:
    part = capture.with_suffix(".part")  # renamed when complete, so that a partial capture is not used
    shutil.rmtree(part, ignore_errors=True)
    command = [*GRAINGS, "synthesize", SCENE, "-o", str(part), "--size", str(SIZE), "--views", str(VIEWS)]
    # Its output names a next command with the folder as it is called until it is renamed; errors are shown.
    if subprocess.run(command, stdout=subprocess.DEVNULL).returncode != 0:
        raise DemoError("the synthetic capture could not be drawn")
    part.rename(capture)


def _fetch(client: Client, job: str, folder: Path, console: Console) -> dict[str, Any]:
    """Fetch views from several viewpoints and times, and the metrics, into `folder`. Returns the metrics."""
    views = folder / "views"
    views.mkdir(parents=True, exist_ok=True)
    for name, viewpoint in VIEWPOINTS.items():
        for t in TIMES:
            client.render(job, views / f"{name}_t{t:.2f}.png", t=t, **viewpoint)
    metrics: dict[str, Any] = json.loads(client.download(job, "metrics", folder / "metrics.json").read_text())
    client.download(job, "curve.svg", folder / "curve.svg")
    console.print(f"Views:   {views} ({len(VIEWPOINTS) * len(TIMES)} files)")
    console.print(f"Metrics: {folder / 'metrics.json'}, {folder / 'curve.svg'}")
    return metrics


@contextmanager
def _service(data: Path, log: Path) -> Iterator[tuple[str, Client]]:
    """Service and worker as child processes, which end with the context; the address and a client of it."""
    data.mkdir(parents=True, exist_ok=True)
    port = _free_port()
    command = [*GRAINGS, "serve", "--with-worker", "--exit-with-parent"]
    command += ["--data", str(data), "--port", str(port)]
    with log.open("ab") as output:
        # In its own session: a Ctrl-C reaches only this process, which then stops the children.
        child = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=output, stderr=output, start_new_session=True)
    url = f"http://127.0.0.1:{port}"
    try:
        with Client(url) as client:
            _wait_until_ready(client, child, log)
            yield url, client
    finally:
        child.terminate()
        child.wait()


def _wait_until_ready(client: Client, child: subprocess.Popen[bytes], log: Path) -> None:
    deadline = time.monotonic() + START_S
    while time.monotonic() < deadline:
        if child.poll() is not None:
            raise DemoError(f"the service ended with code {child.returncode}; see {log}")
        try:
            client.readiness()
        except ClientError:
            time.sleep(0.2)  # not listening yet
        else:
            return
    raise DemoError(f"the service did not start within {START_S:.0f} s; see {log}")


def _free_port() -> int:
    """`PREFERRED_PORT`, or any free port if it is in use."""
    for port in (PREFERRED_PORT, 0):
        with socket.socket() as probe:
            try:
                probe.bind(("127.0.0.1", port))
            except OSError:
                continue
            return int(probe.getsockname()[1])
    raise DemoError("no port is free")
