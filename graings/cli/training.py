"""The verbs that train: one run, or the runs of an ablation.

Functions that `graings.cli.main` makes commands of. Knows nothing of the other verbs, and of exit codes only that of an
interruption.
"""

from __future__ import annotations

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
from graings.cli.terminal import metrics_line, say, waiting
from graings.config import PRESETS, make_config
from graings.report.metrics_document import read_metrics
from graings.training.run import TrainingRun

Threads = Annotated[int | None, typer.Option(min=1, max=256, help="CPU threads; left out: all cores.")]
Preset = Annotated[str | None, typer.Option(help=f"Where defaults come from: {', '.join(PRESETS)}.")]
Settings = Annotated[
    list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Any option of `graings options`.")
]

# Options that take several values after one name.
LISTS: Final = ("--rows", "--seeds")


class Lists(typer.core.TyperCommand):
    """A command whose `LISTS` are given as `--seeds 0 1 2`, up to the next option."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Repeats the name before every value, which is how the parser below knows lists."""
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
        with waiting("reading the capture"):
            run = TrainingRun.resume(output, capture=capture, threads=threads)
    else:
        if capture is None:
            raise typer.BadParameter("say which capture to train on", param_hint="CAPTURE")
        overrides = dict(_setting(text) for text in settings or ())
        if preset is not None:
            _once(preset, overrides)
            overrides["preset"] = preset
        if threads is not None:
            overrides["threads"] = threads
        config = make_config(overrides=overrides)
        with waiting("reading the capture"):
            run = TrainingRun.create(capture, output, config)
    interrupt = _take_steps(run)
    if run.iteration < run.iterations:
        say(f"Stopped after {run.iteration:,} of {run.iterations:,} iterations; nothing is lost.")
        say(f"Continue with: graings train --resume -o {run.folder}")
        raise typer.Exit(interrupt.exit_code)
    _say_result(run)
    say(f"The model, metrics.json, curve.svg and report/ are in {run.folder}.")
    say(f"Look at it: graings render {run.folder} --t 0.5 -o view.png")


def ablate(
    capture: Annotated[
        Path, typer.Argument(metavar="CAPTURE", help="Folder of the capture; it needs validation views.")
    ],
    output: Annotated[Path, typer.Option("--output", "-o", metavar="DIR", help="Folder of the runs and the table.")],
    preset: Preset = None,
    settings: Settings = None,
    seeds: Annotated[
        list[int] | None, typer.Option(metavar="N ...", min=0, help="Seeds that every row gets; left out: 0 1 2.")
    ] = None,
    rows: Annotated[
        list[str] | None,
        typer.Option(
            metavar="ROW ...", help=f"Some of {', '.join(row.name for row in ROWS)}; left out: all that differ."
        ),
    ] = None,
    threads: Threads = None,
) -> None:
    """Train the model and what is left of it without each of its parts, and compare them on validation views.

    The same command again continues where it stopped; more rows and seeds can be added later.
    """
    overrides = dict(_setting(text) for text in settings or ())
    if preset is not None:
        _once(preset, overrides)
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
        say(note)
    left = len(ablation.pending())
    say(f"{len(ablation.runs)} runs, {len(ablation.runs) - left} of them finished.")
    for job, run in ablation:
        say(f"{job.row.label}, seed {job.seed}: {left} to go")
        interrupt = _take_steps(run)
        if run.iteration >= run.iterations:
            _say_result(run)
            left -= 1
        if interrupt.received is not None and left:
            ablation.write()
            say(f"Stopped with {left} runs left; nothing is lost. The same command again goes on.")
            raise typer.Exit(interrupt.exit_code)
    for row in ablation.write().rows:
        mean, difference = row.psnr.mean, row.difference.mean
        if mean is not None:
            say(f"{row.label:>22}  {mean:.2f} dB" + (f"  {signed(difference)}" if difference is not None else ""))
    say(f"The table is in {output / 'ablation.md'}, with ablation.json and ablation.svg beside it.")


def _once(preset: str, overrides: dict[str, Any]) -> None:
    if overrides.get("preset", preset) != preset:
        raise typer.BadParameter(f"the preset is {preset} and {overrides['preset']}; give one of --preset and --set")


def _take_steps(run: TrainingRun) -> Interrupt:
    """Train to the end, or to a checkpoint where a signal asked to stop; returns who would have heard it."""
    with (
        TrainingProgress(Console(), run.iteration, run.iterations) as progress,
        Interrupt("stopping after this step; once more to stop at once") as interrupt,
    ):
        for note in run.capture.notes:
            progress.note(note)
        for step in run:
            progress.show(step)
            if interrupt.received is not None and step.iteration < run.iterations:
                run.save()
                break
    return interrupt


def _say_result(run: TrainingRun) -> None:
    for split, metrics in read_metrics(run.metrics_path).splits.items():
        say(metrics_line(split, metrics))


def _setting(text: str) -> tuple[str, Any]:
    """`key=value` with the value as JSON, or as a string where it is none."""
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
        elif name in LISTS and result[-1] != name:
            result.append(name)
        result.append(argument)
    return result
