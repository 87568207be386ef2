"""The command line: its commands, and errors as one line and an exit code.

The commands that train are in `graings.cli.training`. Commands that need jobs or HTTP are in those packages, found by
the entry-point group `graings.commands`.
"""

from __future__ import annotations

import errno
import sys
from collections.abc import Sequence
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from tempfile import gettempdir
from typing import Annotated, Any, Final, Literal, NoReturn

import typer
import typer.core
from rich.console import Console
from rich.text import Text

from graings.camera.viewpoint import background_rgb
from graings.cli.doctor import doctor
from graings.cli.exporting import export
from graings.cli.footage import capture
from graings.cli.gallery import gallery
from graings.cli.inspecting import inspect
from graings.cli.option_table import show_options
from graings.cli.planning import plan
from graings.cli.rendering import render_view
from graings.cli.synthesize import synthesize
from graings.cli.terminal import metrics_line, motion_line, print_line
from graings.cli.training import FULL_DISK, MultiValueCommand, Threads, ablate, train
from graings.cli.video import video
from graings.errors import (
    CaptureError,
    CheckpointError,
    ConfigError,
    DivergedError,
    GraingsError,
    KernelError,
    OutputError,
)
from graings.kernel import use_threads
from graings.report.evaluate_run import evaluate_run
from graings.report.folder import report_runs
from graings.report.metrics_document import read_metrics
from graings.report.work_precision import summary
from graings.storage.run_folder import METRICS_FILE

UNAVAILABLE: Final = 69  # after sysexits.h, as the others
EXIT_CODES: Final[tuple[tuple[type[Exception], int], ...]] = (
    (ConfigError, 2),
    (CaptureError, 65),
    (CheckpointError, 65),
    (KernelError, UNAVAILABLE),
    (DivergedError, 70),
    (OutputError, 74),
    (OSError, 74),
)
OTHER_PATH: Final = "Choose another path."
REMEDIES: Final[dict[int | None, str]] = {
    errno.ENOENT: "Check the path.",
    **dict.fromkeys(FULL_DISK, "Free some space there."),
    **dict.fromkeys((errno.EACCES, errno.EPERM, errno.EROFS), "Choose another path, or get permission for this one."),
}
EPILOG: Final = (
    "Exit codes: 0 done; 1 a bug, or a reported failure of doctor, demo, serve or worker; 2 wrong usage or option; 65 "
    "the capture or checkpoint cannot be used; 69 the kernel "
    "or a package is missing; 70 training diverged; 74 a file cannot be read or written; 130 interrupted (143 by "
    "SIGTERM); an interrupted training leaves a checkpoint to resume from."
)

RunFolder = Annotated[Path, typer.Argument(metavar="RUN", help="Folder of a run.")]


class Commands(typer.core.TyperGroup):
    """The commands below and those of other installed packages, which are imported when they are used."""

    def list_commands(self, ctx: Any) -> list[str]:
        """Names, in the order of the help page."""
        return [*super().list_commands(ctx), *sorted(entry_points(group="graings.commands").names)]

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """The command of that name, or None."""
        for entry in entry_points(group="graings.commands", name=cmd_name):
            return _package_command(entry)
        return super().get_command(ctx, cmd_name)


app = typer.Typer(
    cls=Commands, no_args_is_help=True, add_completion=False, epilog=EPILOG, pretty_exceptions_enable=False
)


@app.callback()
def graings() -> None:
    """See a moving scene from anywhere, at any time, with nothing but a CPU."""


app.command()(train)
app.command()(plan)
app.command()(inspect)
app.command()(synthesize)
app.command()(capture)
app.command()(doctor)
app.command(cls=MultiValueCommand)(ablate)
app.command(name="render")(render_view)
app.command()(video)
app.command()(export)
app.command()(gallery)
app.command(name="options")(show_options)


@app.command()
def evaluate(
    run: RunFolder,
    split: Annotated[Literal["val", "test", "between"], typer.Option(help="Held-out views to evaluate.")] = "val",
    capture: Annotated[Path | None, typer.Option(help="Folder of the capture, if it was moved since training.")] = None,
    background: Annotated[
        str | None,
        typer.Option(
            help="white, black, #rrggbb or r,g,b for images with alpha, instead of that of training; prints only."
        ),
    ] = None,
    threads: Threads = None,
) -> None:
    """Evaluate a trained model on held-out views and add the metrics to its metrics.json."""
    use_threads(threads)
    try:
        rgb = background_rgb(background) if background is not None else None
    except ValueError as error:
        raise typer.BadParameter(str(error), param_hint="--background") from error
    print_line(metrics_line(split, evaluate_run(run, split, capture, rgb)))
    if rgb is None:
        motion = read_metrics(run / METRICS_FILE).motion
        if motion is not None:
            print_line(motion_line(motion))
        print_line(f"Written to {run / 'metrics.json'}.")
    else:
        print_line(f"On {background}; metrics.json still has the metrics on the background of training.")


@app.command()
def report(
    runs: Annotated[list[Path], typer.Argument(metavar="RUN...", help="Folders of runs, or their metrics.json.")],
    output: Annotated[Path, typer.Option("--output", "-o", metavar="DIR", help="Folder of the report.")],
    render: Annotated[
        bool, typer.Option("--render/--no-render", help="Render the models too: image error against milliseconds.")
    ] = True,
    threads: Threads = None,
) -> None:
    """Compare runs: held-out error against seconds, iterations and Gaussians, as JSON, CSV, SVG and PNG."""
    use_threads(threads)
    try:
        written = report_runs(runs, output, render=render)
    except ValueError as error:
        raise typer.BadParameter(str(error), param_hint="RUN") from error
    for part in written.document.training:
        print_line(summary(part))
        for problem in part.phases.problems:
            print_line(f"{part.run.name}: {problem}")
    for note in written.notes:
        print_line(note)
    print_line(f"Written to {written.folder}: {', '.join(written.files)}.")


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line and exit."""
    try:
        app(args=arguments, prog_name="graings")
    except (GraingsError, OSError) as error:
        _fail(_message(error), next((code for kind, code in EXIT_CODES if isinstance(error, kind)), 1))


def _message(error: Exception) -> str:
    """File, cause and remedy of an error, without the system's error number."""
    if isinstance(error, FileExistsError | NotADirectoryError):
        path = Path(str(error.filename))
        file = next((parent for parent in (path, *path.parents) if parent.is_file()), path)
        return f"{file}: is a file where a folder is needed. {OTHER_PATH}"
    if isinstance(error, OSError) and error.strerror:
        notes = getattr(error, "__notes__", ())  # what a command adds, such as how a training goes on
        name, remedy = f"{error.filename}: ", REMEDIES.get(error.errno, OTHER_PATH)
        if error.filename is None:
            full = error.errno in FULL_DISK  # libraries report it without the file
            name, remedy = "", f"Free some space where the files go, or in {gettempdir()}." if full else remedy
        return " ".join((f"{name}{error.strerror}. {remedy}", *notes))
    return str(error)


def _package_command(entry: EntryPoint) -> Any:
    """The command of an entry point; if it cannot be imported, one that fails with the reason when it is used."""
    group = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
    try:
        command = entry.load()
        if isinstance(command, typer.Typer):
            built = typer.main.get_command(command)
            built.name = entry.name
            return built
        group.command(entry.name)(command)
    except ImportError as error:
        reason = str(error)
        remedy = " Install what is missing." if isinstance(error, ModuleNotFoundError) else ""

        def unavailable() -> None:
            _fail(f"graings {entry.name} is not available: {reason}.{remedy}", UNAVAILABLE)

        any_arguments = {"ignore_unknown_options": True, "allow_extra_args": True}
        group.command(entry.name, help=f"(not available: {reason})", context_settings=any_arguments)(unavailable)
    return typer.main.get_command(group)


def _fail(text: str, code: int) -> NoReturn:
    Console(stderr=True).print(Text(text, style="red"), soft_wrap=True)
    sys.exit(code)
