"""The command that plans a training: what it would leave out, and how long it would take."""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.text import Text

from graings.cli.terminal import busy_status, print_line
from graings.cli.training import Preset, Settings, Threads, check_one_preset, setting
from graings.config import TrainConfig, make_config
from graings.plan.decision import Decision
from graings.plan.plan import Plan
from graings.plan.survey import survey
from graings.training.calibration import calibration

# Parts whose condition says more than the reason does.
NUMBERED = ("deformation", "residual", "preset")
COLORS = {"drop": "green", "propose": "yellow", "later": "cyan", "keep": "default"}


def plan(
    capture: Annotated[Path, typer.Argument(help="Folder of the capture.")],
    preset: Preset = None,
    settings: Settings = None,
    aggressive: Annotated[
        bool, typer.Option("--aggressive", help="Also carry out what only measurements suggest (plan.mode=aggressive).")
    ] = False,
    threads: Threads = None,
    as_json: Annotated[bool, typer.Option("--json", help="The plan document instead of a table.")] = False,
) -> None:
    """Show what a training would leave out, why, and how long it would take. Nothing is trained.

    The first time on a machine some steps of a tiny scene are timed.
    """
    overrides = dict(setting(text) for text in settings or ())
    if preset is not None:
        check_one_preset(preset, overrides)
        overrides["preset"] = preset
    if aggressive:
        overrides["plan.mode"] = "aggressive"
    config = make_config(overrides=overrides)
    with busy_status("timing some steps on this machine (once)"):
        measured = calibration(threads or config.threads)
    with busy_status("reading the capture"):
        planned = survey(capture, config, measured)
    if as_json:
        Console().print_json(json.dumps(planned.to_json()))
        return
    options = [*(settings or ()), *(["plan.mode=aggressive"] if aggressive else ())]
    _print(capture, config, planned, [option for option in options if not option.startswith("preset=")])


def _print(capture: Path, config: TrainConfig, planned: Plan, options: Sequence[str]) -> None:
    for line in _facts(planned):
        print_line(line)
    console = Console()
    console.print(Text(_row("part", "decision", "class", "why"), style="bold"), soft_wrap=True)
    for decision in planned.decisions:
        part = decision.component.replace("_", " ")
        row = _row(part, _verdict(decision), decision.kind, "; ".join(_reasons(decision)))
        console.print(Text(row, style=COLORS[decision.decision]), soft_wrap=True)
    for warning in planned.warnings:
        print_line(f"note: {warning}")
    for line in _costs(config, planned):
        print_line(line)
    command = ["graings", "train", str(capture), "-o", "RUN", "--preset", config.preset]
    print_line(f"Train: {shlex.join([*command, *(part for option in options for part in ('--set', option))])}")


def _facts(planned: Plan) -> list[str]:
    s = planned.statistics
    if s is None:
        return []
    cameras = {
        "fixed": f"{s.cameras} fixed cameras",
        "moving": "a new camera for each image",
        "mixed": f"{s.cameras} cameras, some of them fixed",
    }[s.camera_motion]
    times = "1 time" if s.times == 1 else f"{s.times} times"
    lines = [
        f"{s.images} training images of {s.width}x{s.height} px, {times}, {cameras}; alpha {s.alpha}; "
        + (f"{s.points:,} points; " if s.points else "no point cloud; ")
        + ("lens distortion" if s.distorted else "no lens distortion")
    ]
    noise = "" if s.noise is None else f"noise {255 * s.noise:.2g} grey levels; "
    seen = f"{s.coverage:.0%} of the pixels show something, {s.detail:.1%} have detail"
    lines.append(f"{noise}{seen} ({s.examined} images looked at, {s.cost_s:.1f} s)")
    if s.change is not None and s.gain is not None:
        lines.append(
            f"largest change between times: {255 * s.change.value:.3g} grey levels in a tile of {s.change.image}, "
            f"{s.change.ratio:.3g} times what noise explains; gain {s.gain[0]:.3f} to {s.gain[1]:.3f}"
        )
    return lines


def _verdict(decision: Decision) -> str:
    words = {"drop": "leave out", "propose": "proposed", "later": "judged later", "keep": "keep"}
    return words[decision.decision]


def _row(part: str, verdict: str, kind: str, why: str) -> str:
    return f"{part:<16} {verdict:<12} {kind:<14} {why}"


def _reasons(decision: Decision) -> list[str]:
    """Why, with the number that decided; what it saves; and which option decides otherwise."""
    reasons = [decision.reason]
    condition = decision.condition
    said = condition is None or condition.value is None or condition.name in decision.reason
    single = condition is not None and condition.name.startswith("distinct")
    if condition is not None and not said and not single and decision.component in NUMBERED:
        reasons[0] += f" ({condition})"
    saving = decision.saving
    if saving is not None and saving.predicted_s is not None and saving.predicted_share is not None:
        verb = "saves" if decision.decision == "drop" else "costs"
        reasons.append(f"{verb} about {saving.predicted_s / 60:.1f} min CPU ({saving.predicted_share:.0%})")
    if decision.override is not None and decision.decision in ("drop", "propose", "later"):
        verb = "to do so" if decision.decision == "propose" else "to keep it"
        reasons.append(f"{verb}: {_arguments(decision.override)}")
    return reasons


def _arguments(options: Mapping[str, Any]) -> str:
    """Options, by dotted name, as arguments of `graings train`."""
    parts = [("--preset", str(v)) if k == "preset" else ("--set", f"{k}={json.dumps(v)}") for k, v in options.items()]
    return shlex.join(part for pair in parts for part in pair)


def _costs(config: TrainConfig, planned: Plan) -> list[str]:
    cost = planned.prediction
    if cost is None:
        return ["No prediction of the time: this machine is not calibrated."]
    threads = f"{cost.threads} thread" + ("s" if cost.threads > 1 else "")
    lines = [
        f"{config.preset}, {config.iterations:,} steps: about {cost.minutes:.1f} min with {threads} "
        f"({cost.cpu_s / 60:.1f} min CPU), about {round(cost.gaussians, -2):,} Gaussians"
    ]
    others = [f"{name} {one.minutes:.1f} min" for name, one in planned.alternatives.items() if name != config.preset]
    return [*lines, f"other presets: {', '.join(others)}"] if others else lines
