"""The command that inspects a capture before anything is trained."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from graings.cli.terminal import busy_status, print_line
from graings.cli.training import Settings, setting
from graings.config import make_config
from graings.inspection.inspect import inspect_capture
from graings.storage.files import check_writable, write_bytes
from graings.training.calibration import kept_calibration


def inspect(
    capture: Annotated[Path, typer.Argument(help="Folder of the capture.")],
    picture: Annotated[
        Path | None,
        typer.Option("--picture", "-o", metavar="PNG", help="Write some images with the bounds of the scene there."),
    ] = None,
    settings: Settings = None,
    as_json: Annotated[bool, typer.Option("--json", help="The document instead of text.")] = False,
) -> None:
    """Show what is in a capture, what is suspicious about it, and what trainings would take. Nothing is trained."""
    if picture is not None:
        if picture.suffix.lower() != ".png":
            raise typer.BadParameter(f"{picture} must end in .png, the format of the picture", param_hint="--picture")
        check_writable(picture)
    overrides = dict(setting(text) for text in settings or ())
    for name in overrides:
        if name.partition(".")[0] != "capture":
            problem = f"{name} is no option of reading a capture (capture.*). For others: graings plan --set"
            raise typer.BadParameter(problem, param_hint="--set")
    config = make_config(overrides=overrides)
    with busy_status("reading the capture, and matching its pictures"):
        document, png = inspect_capture(capture, config.capture, kept_calibration(), picture=picture is not None)
    if picture is not None and png is not None:
        write_bytes(picture, png)
    if as_json:
        Console().print_json(json.dumps(document.to_json()))
        return
    for line in document.lines():
        print_line(line)
