"""The command `demo`: train a synthetic moving scene over HTTP and fetch views of it.

It starts the service and a worker as `graings serve --with-worker` does, draws the synthetic capture, submits it,
shows the progress of training, and fetches views and metrics. It uses the REST interface like any other client.
"""

from __future__ import annotations

import io
import json
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any
from urllib.parse import urlencode

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from graings.capture.synthetic import synthesize
from graings.kernel.threads import usable_cores
from jobs.job import JobState

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
POLL_S = 0.5


@dataclass(frozen=True, slots=True)
class Api:
    """A minimal REST client. `url` has no slash at its end."""

    url: str

    def fetch(self, path: str, body: bytes | None = None, kind: str = "application/json") -> bytes:
        """The body of the response to a POST of `body`, or to a GET without a body. Raises `DemoError`."""
        request = urllib.request.Request(self.url + path, data=body, headers={"Content-Type": kind})
        try:
            with urllib.request.urlopen(request, timeout=120) as response:
                content: bytes = response.read()
                return content
        except urllib.error.HTTPError as error:
            problem = json.loads(error.read())
            raise DemoError(f"{path}: {problem.get('detail') or problem['title']}") from error

    def json(self, path: str, body: bytes | None = None, kind: str = "application/json") -> Any:
        return json.loads(self.fetch(path, body, kind))


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
        with _service(folder / "service", folder / "service.log") as api:
            job = _train(api, folder, console)
            metrics = _fetch(api, job, folder, console)
            console.print(f"Held-out PSNR [bold]{metrics['splits']['val']['psnr']:.2f} dB[/] (validation views)")
            console.print(f"Total time {time.monotonic() - started:.0f} s.")
            if not once:
                console.print(
                    f"Serving at [bold]{api.url}[/] — drag to orbit, move the time slider. Press Ctrl-C to stop."
                )
                serving = True
                threading.Event().wait()
    except KeyboardInterrupt:
        # The child processes have ended. It is a failure only if the views are not written yet.
        raise typer.Exit(0 if serving else 130) from None
    except DemoError as error:
        console.print(f"[red]demo:[/] {error}")
        raise typer.Exit(1) from error


def _train(api: Api, folder: Path, console: Console) -> str:
    """Submit the capture and wait for the end of the job; returns its id."""
    capture = folder / SCENE
    if not capture.exists():
        _draw_capture(capture, console)
    console.print(f"Capture: {capture} ({VIEWS} training images of {SIZE} px)")
    query = urlencode({"preset": PRESET, "name": SCENE, "config": json.dumps(OPTIONS)})
    job = api.json(f"/jobs?{query}", _zipped(capture), "application/zip")
    console.print(f"Job:     {api.url}{job['links']['self']}")
    columns = (
        TextColumn("{task.fields[phase]:>8}"),
        BarColumn(),
        TextColumn("{task.completed:.0f}/{task.total:.0f}"),
        TextColumn("{task.fields[details]}"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console) as progress:
        bar = progress.add_task("train", total=OPTIONS["iterations"], phase="waiting", details="")
        while not JobState(job["state"]).final:
            time.sleep(POLL_S)
            job = api.json(job["links"]["self"])
            report = job["progress"]
            if report:
                details = ""
                if report["psnr"] is not None:
                    details = f"{report['psnr']:.1f} dB · {report['gaussians']} Gaussians"
                progress.update(bar, completed=report["iteration"], phase=report["phase"], details=details)
    if job["state"] != JobState.SUCCEEDED:
        raise DemoError(f"the job has {job['state']}: {job['error']}. Its log: {api.url}{job['links']['log']}")
    return str(job["id"])


def _draw_capture(capture: Path, console: Console) -> None:
    part = capture.with_suffix(".part")  # renamed when complete, so that a partial capture is not used
    shutil.rmtree(part, ignore_errors=True)
    columns = (TextColumn("    draw"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console) as progress:
        bar = progress.add_task("draw", total=None)
        synthesize(
            SCENE,
            part,
            size=SIZE,
            views=VIEWS,
            processes=usable_cores(),
            observe=lambda done, total: progress.update(bar, completed=done, total=total),
        )
    part.rename(capture)


def _fetch(api: Api, job: str, folder: Path, console: Console) -> dict[str, Any]:
    """Fetch views from several viewpoints and times, and the metrics, into `folder`. Returns the metrics."""
    views = folder / "views"
    views.mkdir(parents=True, exist_ok=True)
    for name, viewpoint in VIEWPOINTS.items():
        for t in TIMES:
            image = api.fetch("/render?" + urlencode({"job": job, "t": t, "format": "png", **viewpoint}))
            (views / f"{name}_t{t:.2f}.png").write_bytes(image)
    metrics: dict[str, Any] = api.json(f"/jobs/{job}/metrics")
    (folder / "metrics.json").write_text(json.dumps(metrics, indent=1))
    (folder / "curve.svg").write_bytes(api.fetch(f"/jobs/{job}/curve.svg"))
    console.print(f"Views:   {views} ({len(VIEWPOINTS) * len(TIMES)} files)")
    console.print(f"Metrics: {folder / 'metrics.json'}, {folder / 'curve.svg'}")
    return metrics


@contextmanager
def _service(data: Path, log: Path) -> Iterator[Api]:
    """Service and worker as child processes, which end with the context."""
    data.mkdir(parents=True, exist_ok=True)
    port = _free_port()
    command = [sys.executable, "-m", "service.commands", "--with-worker", "--exit-with-parent"]
    command += ["--data", str(data), "--port", str(port)]
    with log.open("ab") as output:
        # In its own session: a Ctrl-C reaches only this process, which then stops the children.
        child = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=output, stderr=output, start_new_session=True)
    try:
        api = Api(f"http://127.0.0.1:{port}")
        _wait_until_ready(api, child, log)
        yield api
    finally:
        child.terminate()
        child.wait()


def _wait_until_ready(api: Api, child: subprocess.Popen[bytes], log: Path) -> None:
    deadline = time.monotonic() + START_S
    while time.monotonic() < deadline:
        if child.poll() is not None:
            raise DemoError(f"the service ended with code {child.returncode}; see {log}")
        try:
            api.json("/readyz")
        except OSError:
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


def _zipped(folder: Path) -> bytes:
    memory = io.BytesIO()
    # Images are compressed already.
    with zipfile.ZipFile(memory, "w", zipfile.ZIP_STORED) as archive:
        for path in sorted(folder.rglob("*")):
            if path.is_file():
                archive.write(path, path.relative_to(folder))
    return memory.getvalue()
