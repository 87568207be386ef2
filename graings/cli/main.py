"""The command line: one verb per thing a person wants done.

Reads arguments, calls the library, prints, and turns errors into one line and an exit code. The verbs that train are in
`graings.cli.training`. Verbs that need jobs or HTTP live in those packages and join through the entry-point group
`graings.commands`; this module does not know their names.
"""

from __future__ import annotations

import errno
import json
import math
import sys
import time
from collections.abc import Iterator, Sequence
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Annotated, Any, Final, Literal, NoReturn, get_args

import typer
import typer.core
from rich.console import Console
from rich.table import Table
from rich.text import Text

from graings.camera.camera import Camera
from graings.camera.viewpoint import background_rgb, named_view, orbit_view, pose_camera, sized
from graings.cli.synthesize import synthesize
from graings.cli.terminal import metrics_line, motion_line, say
from graings.cli.training import Lists, Threads, ablate, train
from graings.config import ConfigSection, make_config, options
from graings.errors import CaptureError, CheckpointError, ConfigError, DivergedError, GraingsError, KernelError
from graings.image_encoding import encode_image, image_format
from graings.kernel import use_threads
from graings.render import render
from graings.report.evaluate_run import evaluate_run
from graings.report.folder import report_runs
from graings.report.metrics_document import METRICS_FILE, read_metrics
from graings.report.work_precision import summary
from graings.storage.compact import SUFFIX, open_model, write_compact
from graings.storage.model import Model, scene_bytes

MISSING: Final = 69
LONGEST_SIDE: Final = 16384  # of a picture, in pixels
EXIT_CODES: Final[tuple[tuple[type[Exception], int], ...]] = (
    (ConfigError, 2),
    (CaptureError, 65),
    (CheckpointError, 65),
    (KernelError, MISSING),
    (DivergedError, 70),
    (OSError, 74),
)
REMEDIES: Final[dict[int | None, str]] = {
    errno.ENOENT: "Check the path.",
    **dict.fromkeys((errno.ENOSPC, errno.EDQUOT), "Free some space there; training goes on with --resume."),
    **dict.fromkeys((errno.EACCES, errno.EPERM, errno.EROFS), "Name another place, or have this one opened to you."),
}
EPILOG: Final = (
    "Exit codes: 0 done; 1 a bug; 2 wrong usage or option; 65 the capture or checkpoint cannot be used; 69 the kernel "
    "or a package is missing; 70 training diverged; 74 a file cannot be read or written; 130 interrupted (143 by "
    "SIGTERM), for training with a checkpoint to resume from."
)

Run = Annotated[Path, typer.Argument(metavar="RUN", help="Folder of a run.")]
Shown = Annotated[
    Path, typer.Argument(metavar="RUN", help="Folder of a run, one of its checkpoints, or an exported .graings file.")
]


class Verbs(typer.core.TyperGroup):
    """The verbs below and those of other installed packages, which are loaded when they are used."""

    def list_commands(self, ctx: Any) -> list[str]:
        """Names in the order of the help page."""
        return [*super().list_commands(ctx), *sorted(entry_points(group="graings.commands").names)]

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """The command of that name, or None."""
        for entry in entry_points(group="graings.commands", name=cmd_name):
            return _joined(entry)
        return super().get_command(ctx, cmd_name)


app = typer.Typer(cls=Verbs, no_args_is_help=True, add_completion=False, epilog=EPILOG, pretty_exceptions_enable=False)


@app.callback()
def graings() -> None:
    """See a moving scene from anywhere, at any time, with nothing but a CPU."""


app.command()(train)
app.command()(synthesize)
app.command(cls=Lists)(ablate)


@app.command(name="render")
def render_view(
    run: Shown,
    output: Annotated[Path, typer.Option("--output", "-o", help="Image file: .png, .jpg, .webp or .exr.")],
    t: Annotated[float | None, typer.Option(help="Time from 0 to 1; left out: that of --camera, or 0.")] = None,
    camera: Annotated[str | None, typer.Option(help="A view of the capture, such as test:3.")] = None,
    azimuth: Annotated[float | None, typer.Option(help="Degrees about the vertical axis.")] = None,
    elevation: Annotated[float | None, typer.Option(help="Degrees above the horizon.")] = None,
    radius: Annotated[float | None, typer.Option(help="Distance to the target in the capture's units.")] = None,
    target: Annotated[
        tuple[float, float, float] | None,
        typer.Option(metavar="X Y Z", help="What to look at, in the capture's units."),
    ] = None,
    fov: Annotated[float | None, typer.Option(help="Horizontal field of view in degrees.")] = None,
    pose: Annotated[
        Path | None, typer.Option(help="JSON: world_to_camera (4x4, OpenCV axes), fx, fy, cx, cy, width, height.")
    ] = None,
    width: Annotated[int | None, typer.Option(min=1, max=LONGEST_SIDE, help="Pixels.")] = None,
    height: Annotated[int | None, typer.Option(min=1, max=LONGEST_SIDE, help="Pixels.")] = None,
    background: Annotated[
        str | None, typer.Option(help="white, black, #rrggbb or r,g,b; left out: as trained.")
    ] = None,
    threads: Threads = None,
) -> None:
    """Draw one view at one time; without a camera, an orbit at the height of the training views."""
    use_threads(threads)
    orbit = any(value is not None for value in (azimuth, elevation, radius, target, fov))
    if (camera is not None) + (pose is not None) + orbit > 1:
        raise typer.BadParameter("choose one of --camera, --pose and an orbit (--azimuth, --elevation, ...)")
    if t is not None and not math.isfinite(t):
        raise typer.BadParameter(f"time must be a number from 0 to 1, got {t}", param_hint="--t")
    try:
        format = image_format(output.suffix)
        rgb = background_rgb(background) if background is not None else None
        model = open_model(run)
        if camera is not None:
            named = named_view(model.views, camera)
            view, own_time = sized(named.camera, width, height), named.time
        elif pose is not None:
            view, own_time = sized(_read_pose(pose, model), width, height), 0.0
        else:
            around = model.views["train"]
            view = orbit_view(around, model.units, azimuth, elevation, radius, target, fov, width, height)
            own_time = 0.0
    except ValueError as error:
        raise typer.BadParameter(str(error)) from error
    moment = own_time if t is None else min(max(t, 0.0), 1.0)
    if t is not None and moment != t:
        say(f"Time {t:g} lies outside the capture; drawn at {moment:g}.")
    started = time.perf_counter()
    result = render(model.scene, view, moment, rgb or model.background)
    milliseconds = 1e3 * (time.perf_counter() - started)
    output.write_bytes(encode_image(result.color.numpy(), format))
    say(f"{output}: {view.width} x {view.height} at t = {moment:g}, drawn in {milliseconds:.0f} ms.")


@app.command()
def export(
    run: Shown,
    output: Annotated[Path, typer.Option("--output", "-o", help=f"File to write, such as scene{SUFFIX}.")],
) -> None:
    """Write a model as one small file that `graings render` takes in place of the run."""
    model = open_model(run)
    size = write_compact(model, output)
    say(f"{output}: {size / 1e6:.2f} MB, {scene_bytes(model.scene) / 1e6:.2f} MB in float32.")


@app.command()
def evaluate(
    run: Run,
    split: Annotated[Literal["val", "test", "between"], typer.Option(help="Held-out views to measure.")] = "val",
    capture: Annotated[Path | None, typer.Option(help="Where the capture lies now, if it moved.")] = None,
    background: Annotated[
        str | None, typer.Option(help="white, black, #rrggbb or r,g,b instead of training's; only told, not written.")
    ] = None,
    threads: Threads = None,
) -> None:
    """Measure a trained model on held-out views and add the numbers to its metrics.json."""
    use_threads(threads)
    try:
        rgb = background_rgb(background) if background is not None else None
    except ValueError as error:
        raise typer.BadParameter(str(error), param_hint="--background") from error
    say(metrics_line(split, evaluate_run(run, split, capture, rgb)))
    if rgb is None:
        motion = read_metrics(run / METRICS_FILE).motion
        if motion is not None:
            say(motion_line(motion))
        say(f"Written to {run / 'metrics.json'}.")
    else:
        say(f"On {background}; metrics.json keeps the numbers on the background of training.")


@app.command()
def report(
    runs: Annotated[list[Path], typer.Argument(metavar="RUN...", help="Folders of runs, or their metrics.json.")],
    output: Annotated[Path, typer.Option("--output", "-o", metavar="DIR", help="Folder of the report.")],
    render: Annotated[
        bool, typer.Option("--render/--no-render", help="Draw the models too: picture error against milliseconds.")
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
        say(summary(part))
        for problem in part.phases.problems:
            say(f"{part.run.name}: {problem}")
    for note in written.notes:
        say(note)
    say(f"Written to {written.folder}: {', '.join(written.files)}.")


@app.command(name="options")
def show_options(
    preset: Annotated[str, typer.Option(help="Show the values of this preset.")] = "standard",
    as_json: Annotated[bool, typer.Option("--json", help="JSON schema and presets instead of a table.")] = False,
) -> None:
    """List every option that --set understands."""
    console = Console()
    if as_json:
        console.print_json(json.dumps(options()))
        return
    table = Table("option", "value", "bounds", "", box=None, pad_edge=False, header_style="bold")
    for name, value, bounds, text in _fields(make_config(preset)):
        table.add_row(Text(name), Text(value, style="cyan"), Text(bounds, style="dim"), Text(text))
    console.print(table)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line and exit."""
    try:
        app(args=arguments, prog_name="graings")
    except (GraingsError, OSError) as error:
        _fail(_words(error), next((code for kind, code in EXIT_CODES if isinstance(error, kind)), 1))


def _words(error: Exception) -> str:
    """What happened to which file, and what to do, instead of the system's number for it."""
    if isinstance(error, FileExistsError | NotADirectoryError):
        place = Path(str(error.filename))
        taken = next((one for one in (place, *place.parents) if one.is_file()), place)
        return f"{taken}: is a file where a folder is wanted. Name another place."
    if isinstance(error, OSError) and error.strerror:
        file = "" if error.filename is None else f"{error.filename}: "  # a full disk is told of without its file
        return f"{file}{error.strerror}. {REMEDIES.get(error.errno, 'Name another place.')}"
    return str(error)


def _joined(entry: EntryPoint) -> Any:
    """The command of an entry point; where it cannot be loaded, one that says why when it is used."""
    one = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
    try:
        one.command(entry.name)(entry.load())
    except ImportError as error:
        reason = str(error)

        def missing() -> None:
            _fail(f"graings {entry.name} is not available here: {reason}. Install what is missing.", MISSING)

        anything = {"ignore_unknown_options": True, "allow_extra_args": True}
        one.command(entry.name, help=f"(not available: {reason})", context_settings=anything)(missing)
    return typer.main.get_command(one)


def _read_pose(file: Path, model: Model) -> Camera:
    """The camera in a pose file; `ValueError` naming the key that is missing or wrong."""
    try:
        document = json.loads(file.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{file}: not JSON ({error})") from error
    keys = ("world_to_camera", "fx", "fy", "cx", "cy", "width", "height")
    absent = [key for key in keys if key not in document] if isinstance(document, dict) else list(keys)
    if absent:
        raise ValueError(f"{file}: {', '.join(absent)} missing; a pose needs {', '.join(keys)}")
    for key in ("width", "height"):
        if type(document[key]) is not int or not 1 <= document[key] <= LONGEST_SIDE:
            raise ValueError(f"{file}: {key} must be a whole number from 1 to {LONGEST_SIDE}, got {document[key]!r}")
    try:
        return pose_camera(model.units, *(document[key] for key in keys))
    except (ValueError, TypeError, OverflowError) as error:
        raise ValueError(f"{file}: {error}") from error


def _fields(part: ConfigSection, prefix: str = "") -> Iterator[tuple[str, str, str, str]]:
    """Name, value, bounds and help of every option below `part`."""
    for name, field in type(part).model_fields.items():
        value = getattr(part, name)
        if isinstance(value, ConfigSection):
            yield from _fields(value, f"{prefix}{name}.")
            continue
        signs = (("ge", "≥"), ("gt", ">"), ("le", "≤"), ("lt", "<"))
        items = [info for item in get_args(field.annotation)[:1] for info in getattr(item, "__metadata__", ())]
        limits = [*field.metadata, *(limit for info in items for limit in info.metadata)]  # its own, or of each item
        bounds = [f"{sign} {getattr(m, key)}" for m in limits for key, sign in signs if hasattr(m, key)]
        yield f"{prefix}{name}", json.dumps(value), ", ".join(bounds), field.description or ""


def _fail(text: str, code: int) -> NoReturn:
    Console(stderr=True).print(Text(text, style="red"), soft_wrap=True)
    sys.exit(code)
