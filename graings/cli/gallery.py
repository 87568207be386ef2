"""The command that writes a gallery of trained models. `graings.cli.main` registers it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from graings.api.gallery import write_gallery
from graings.cli.terminal import print_line, task_progress
from graings.cli.training import Threads
from graings.kernel import use_threads


def gallery(
    runs: Annotated[list[Path], typer.Argument(metavar="RUN...", help="Folders of finished runs.")],
    output: Annotated[Path, typer.Option("--output", "-o", metavar="DIR", help="Folder to write.")],
    title: Annotated[str, typer.Option(help="Heading of the page.")] = "Moving scenes",
    threads: Threads = None,
) -> None:
    """Write a page with a clip of each model, its numbers, and a player of its scene. It needs no server."""
    use_threads(threads)
    with task_progress() as bar:
        task = bar.add_task("rendering", total=None)
        try:
            page = write_gallery(
                runs, output, title=title, observe=lambda done, total: bar.update(task, completed=done, total=total)
            )
        except ValueError as error:
            raise typer.BadParameter(str(error), param_hint="RUN") from error
    print_line(f"{page}: open it in a browser.")
