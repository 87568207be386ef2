"""The command `doctor`: whether this machine has what GrainGS needs, and what to do where it has not."""

from __future__ import annotations

import platform
import shutil
import sys
from collections.abc import Callable, Iterable
from importlib.metadata import entry_points, version
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Final, Literal

import torch
import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text

from graings.colmap import pycolmap_remedy
from graings.errors import GraingsError
from graings.evaluation.perceptual import PerceptualDistances
from graings.kernel import active_isa, available_isas, has_bfloat16_products
from graings.kernel.threads import usable_cores

# What is wrong: nothing, something that only some uses need, or something that everything needs.
Verdict = Literal["ok", "missing", "broken"]
Check = tuple[str, Verdict, str]

MIN_FREE_GB: Final = 2.0
# Packages of extras: the name of the extra, and what they are for.
OPTIONAL: Final = {
    "av": ("video", "videos, and captures from videos"),
    "gaussforge": ("splats", "files of splats: .compressed.ply, .spz, .sog, .splat, .ksplat"),
    "fourdgs": ("splats", ".4dgs files"),
}
COLORS: Final = {"ok": "green", "missing": "yellow", "broken": "red"}


def doctor(
    data: Annotated[
        Path, typer.Option(envvar="GRAINGS_DATA", help="The service's folder with captures and jobs.")
    ] = Path("data"),
) -> None:
    """Look whether this machine has what GrainGS needs; ends with 1 if something does not work."""
    table = Table("", "check", "", box=None)
    checks = [*_machine(), _disk(data), *_extras()]
    # Packages that bring commands bring their checks.
    for entry in sorted(entry_points(group="graings.checks"), key=lambda entry: entry.name):
        found: Callable[[Path], Iterable[Check]] = entry.load()
        checks += found(data)
    for name, verdict, text in checks:
        table.add_row(Text(verdict, COLORS[verdict]), name, Text(text))
    Console().print(table)
    raise typer.Exit(int(any(verdict == "broken" for _, verdict, _ in checks)))


def _machine() -> Iterable[Check]:
    yield "python", "ok", f"{platform.python_version()} on {platform.machine()}, {usable_cores()} usable cores"
    yield "graings", "ok", f"{version('graings')}, torch {torch.__version__}"
    try:
        networks = f"networks train in {'bfloat16 (AMX)' if has_bfloat16_products() else 'float32'}"
        yield "kernel", "ok", f"uses {active_isa()} of {', '.join(available_isas())}; {networks}"
    except (GraingsError, ImportError) as error:
        yield "kernel", "broken", f"{error} Install it again with a C++20 compiler: scripts/setup"


def _disk(data: Path) -> Check:
    folder = next(folder for folder in (data.resolve(), *data.resolve().parents) if folder.exists())
    free = shutil.disk_usage(folder).free / 1e9
    text = f"{free:.1f} GB free in {folder}"
    return "disk", "ok" if free >= MIN_FREE_GB else "broken", text if free >= MIN_FREE_GB else f"{text}: delete jobs"


def _extras() -> Iterable[Check]:
    try:
        import pycolmap

        yield "pycolmap", "ok", f"{pycolmap.__version__}: lens distortion, triangulation, `graings capture`"
    except ImportError:
        yield "pycolmap", "missing", f"no lens distortion, triangulation or `graings capture`: {pycolmap_remedy()}"
    for package, (extra, use) in OPTIONAL.items():
        if find_spec(package) is None:
            yield package, "missing", f"no {use}: pip install 'graings[{extra}]'"
        else:
            yield package, "ok", f"{version(package)}: {use}"
    distances = PerceptualDistances.find()
    for name, metric in (("LPIPS", distances.lpips), ("FLIP", distances.flip)):
        yield name, "missing" if metric.reason else "ok", metric.reason or "can be measured"
    compiler = next((name for name in ("c++", "g++", "clang++") if shutil.which(name)), None)
    yield "compiler", "ok" if compiler else "missing", compiler or "needed only to compile the kernel"
    if sys.platform == "win32":
        yield "fcntl", "broken", "jobs and service need Linux, macOS or WSL"
