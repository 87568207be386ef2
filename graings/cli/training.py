"""The commands that train: one run, or the runs of an ablation. `graings.cli.main` registers them."""

from __future__ import annotations

import errno
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Final

import typer
import typer.core
from rich.console import Console

from graings.ablation.experiment import Ablation
from graings.ablation.rows import ROWS
from graings.ablation.table import signed
from graings.cli.interrupt import Interrupt
from graings.cli.progress import TrainingProgress
from graings.cli.terminal import busy_status, metrics_line, print_line
from graings.config import PRESETS, make_config
from graings.errors import DivergedError
from graings.plan.contradictions import nothing_shown
from graings.report.metrics_document import read_metrics
from graings.storage.checkpoint import newest_checkpoint
from graings.storage.run_folder import RECORD_FILE
from graings.training.run import TrainingRun

Threads = Annotated[int | None, typer.Option(min=1, max=256, help="CPU threads (default: all cores).")]
Preset = Annotated[str | None, typer.Option(help=f"Where defaults come from: {', '.join(PRESETS)}.")]
Settings = Annotated[
    list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Any option of `graings options`.")
]

FULL_DISK: Final = (errno.ENOSPC, errno.EDQUOT)
MULTI_VALUE: Final = ("--rows", "--seeds")


class MultiValueCommand(typer.core.TyperCommand):
    """A command whose options `MULTI_VALUE` take all values up to the next option, as in `--seeds 0 1 2`."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Repeats the option before each value, which is the form that click parses."""
        return super().parse_args(ctx, _repeated(args))


def train(
    output: Annotated[Path, typer.Option("--output", "-o", metavar="RUN", help="Folder of the run.")],
    capture: Annotated[Path | None, typer.Argument(help="Folder of the capture; optional with --resume.")] = None,
    preset: Preset = None,
    settings: Settings = None,
    resume: Annotated[bool, typer.Option("--resume", help="Continue RUN from its newest checkpoint.")] = False,
    threads: Threads = None,
) -> None:
    """Train a model on a capture."""
    if resume:
        if preset is not None or settings:
            raise typer.BadParameter("a resumed run keeps its options; leave out --preset and --set")
        with busy_status("reading the capture"):
            run = TrainingRun.resume(output, capture=capture, threads=threads)
    else:
        if capture is None:
            raise typer.BadParameter("name the folder of the capture to train on", param_hint="CAPTURE")
        overrides = dict(setting(text) for text in settings or ())
        if preset is not None:
            check_one_preset(preset, overrides)
            overrides["preset"] = preset
        if threads is not None:
            overrides["threads"] = threads
        config = make_config(overrides=overrides)
        with busy_status("reading the capture, and placing the first points"):
            try:
                run = TrainingRun.create(capture, output, config)
            except KeyboardInterrupt:
                if (output / RECORD_FILE).exists():
                    print_line(f"Stopped before the first step. Continue with: graings train --resume -o {output}")
                raise
    interrupt = _take_steps(run, again=f"Then continue with: graings train --resume -o {run.folder}")
    if run.iteration < run.iterations:
        print_line(f"Stopped after {run.iteration:,} of {run.iterations:,} iterations, {kept_checkpoint(run)}.")
        print_line(f"Continue with: graings train --resume -o {run.folder}")
        raise typer.Exit(interrupt.exit_code)
    _print_result(run)
    print_line(f"The model, metrics.json, curve.svg and report/ are in {run.folder}.")
    print_line(f"Render a view: graings render {run.folder} --t 0.5 -o view.png")


def ablate(
    capture: Annotated[
        Path, typer.Argument(metavar="CAPTURE", help="Folder of the capture; it needs validation views.")
    ],
    output: Annotated[Path, typer.Option("--output", "-o", metavar="DIR", help="Folder of the runs and the table.")],
    preset: Preset = None,
    settings: Settings = None,
    seeds: Annotated[
        list[int] | None, typer.Option(metavar="N ...", min=0, help="Seeds of every row (default: 0 1 2).")
    ] = None,
    rows: Annotated[
        list[str] | None,
        typer.Option(
            metavar="ROW ...", help=f"Some of {', '.join(row.name for row in ROWS)} (default: all that differ)."
        ),
    ] = None,
    threads: Threads = None,
) -> None:
    """Train the model and variants without one of its parts, and compare them on validation views.

    Run the same command again to continue; rows and seeds can be added later.
    """
    overrides = dict(setting(text) for text in settings or ())
    if preset is not None:
        check_one_preset(preset, overrides)
    named = str(overrides.pop("preset", "standard"))
    ablation = Ablation(
        *(output, capture),
        preset=preset or named,
        settings=overrides,
        rows=rows or (),
        seeds=seeds or (0, 1, 2),
        threads=threads,
    )
    for note in ablation.notes:
        print_line(note)
    left = len(ablation.pending())
    print_line(f"{len(ablation.runs)} runs, {len(ablation.runs) - left} of them finished.")
    for job, run in ablation:
        print_line(f"{job.row.label}, seed {job.seed}: {left} to go")
        try:
            interrupt = _take_steps(run, again="Then run the same command again to continue.")
        except DivergedError as error:
            print_line(str(error))
            left -= 1
            continue
        if run.iteration >= run.iterations:
            _print_result(run)
            left -= 1
        if interrupt.received is not None and left:
            ablation.write()
            print_line(f"Stopped with {left} runs left. Run the same command again to continue.")
            raise typer.Exit(interrupt.exit_code)
    for row in ablation.write().rows:
        mean, difference = row.psnr.mean, row.difference.mean
        if mean is not None:
            print_line(
                f"{row.label:>22}  {mean:.2f} dB" + (f"  {signed(difference)}" if difference is not None else "")
            )
    print_line(f"The table is in {output / 'ablation.md'}, with ablation.json and ablation.svg beside it.")
    diverged = ", ".join(str(job.folder) for job in ablation.runs if job.diverged)
    if diverged:
        remedy = "Delete a folder to train it from the start; the same command tries to go on with it."
        raise DivergedError(f"{diverged}: diverged, and left out of the table. {remedy}")


def kept_checkpoint(run: TrainingRun) -> str:
    """The checkpoint from which a run that was stopped continues, in words."""
    newest = newest_checkpoint(run.folder)
    if newest is None or int(newest.name) == run.iteration:
        return "at a checkpoint"
    return f"with the checkpoint of iteration {int(newest.name):,}, as the loss is far above its best"


def check_one_preset(preset: str, overrides: dict[str, Any]) -> None:
    if overrides.get("preset", preset) != preset:
        raise typer.BadParameter(f"the preset is {preset} and {overrides['preset']}; give one of --preset and --set")


def _take_steps(run: TrainingRun, again: str) -> Interrupt:
    """Train to the end, or until a signal, and then save a checkpoint. Returns the interrupt.

    `again` says how to continue after an error of a full disk.
    """
    with (
        TrainingProgress(Console(), run.iteration, run.iterations) as progress,
        Interrupt("stopping after this step; press Ctrl-C again to stop at once") as interrupt,
    ):
        seen = run.log.plan.statistics
        for note in (*run.capture.notes, *(() if seen is None else nothing_shown(seen))):
            progress.note(note)
        try:
            for step in run:
                progress.show(step)
                if interrupt.received is not None and step.iteration < run.iterations:
                    run.save()
                    break
        except OSError as error:
            if error.errno in FULL_DISK:
                error.add_note(again)
            raise
    return interrupt


def _print_result(run: TrainingRun) -> None:
    for split, metrics in read_metrics(run.metrics_path).splits.items():
        print_line(metrics_line(split, metrics))


def setting(text: str) -> tuple[str, Any]:
    """Key and value of `key=value`, the value as JSON if it is valid JSON, else as a string."""
    key, equals, value = text.partition("=")
    if not equals or not key:
        raise typer.BadParameter(f"must look like key=value, got {text!r}", param_hint="--set")
    try:
        return key, json.loads(value)
    except (ValueError, RecursionError):
        return key, value


def _repeated(arguments: Sequence[str]) -> list[str]:
    """`--seeds 0 1` as `--seeds 0 --seeds 1`."""
    result: list[str] = []
    name = ""
    for argument in arguments:
        if argument.startswith("-"):
            name = argument.partition("=")[0]
        elif name in MULTI_VALUE and result[-1] != name:
            result.append(name)
        result.append(argument)
    return result
