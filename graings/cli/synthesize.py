"""The command that writes synthetic captures."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text

from graings.capture.synthetic import SUITE
from graings.capture.synthetic import synthesize as write_scene
from graings.cli.terminal import print_line, task_progress
from graings.kernel.threads import usable_cores


def synthesize(
    name: Annotated[str | None, typer.Argument(metavar="NAME", help="A scene; --list shows them.")] = None,
    output: Annotated[Path | None, typer.Option("--output", "-o", metavar="DIR", help="Folder to write.")] = None,
    size: Annotated[int, typer.Option(min=1, max=4096, help="Width and height of the images in pixels.")] = 400,
    views: Annotated[int, typer.Option(min=1, max=100_000, help="Training images; held-out views are added.")] = 150,
    seed: Annotated[int, typer.Option(min=0, help="Cameras and patterns; the same seed gives the same pixels.")] = 0,
    processes: Annotated[int | None, typer.Option(min=1, help="Processes (default: one for each usable core).")] = None,
    show: Annotated[bool, typer.Option("--list", help="List the scenes and what each of them tests.")] = False,
) -> None:
    """Write a synthetic moving scene as a capture, with depth, masks and trajectories as ground truth."""
    if show:
        table = Table("scene", "tests", box=None, pad_edge=False, header_style="bold")
        for entry in SUITE:
            table.add_row(Text(entry.name, style="cyan"), Text(entry.question))
        Console().print(table)
        return
    if name is None:
        raise typer.BadParameter("name a scene, or give --list", param_hint="NAME")
    if output is None:
        raise typer.BadParameter("name the folder to write", param_hint="--output")
    with task_progress() as bar:
        task = bar.add_task("rendering", total=None)
        try:
            write_scene(
                name,
                output,
                size=size,
                views=views,
                seed=seed,
                processes=processes or usable_cores(),
                observe=lambda done, total: bar.update(task, completed=done, total=total),
            )
        except ValueError as error:
            raise typer.BadParameter(str(error), param_hint="NAME") from error
    print_line(f"Written to {output}. Next: graings train {output} --output RUN.")
