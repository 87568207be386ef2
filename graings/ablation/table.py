"""Table: the numbers of an ablation as one document, and that document as a page of Markdown.

Differences are to the full model of the same seed, so that the effect of the seed on both cancels.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping, Sequence
from typing import Any, Final, Literal

from pydantic import Field

from graings.ablation.rows import FULL, SCENES, PaperResult, Row
from graings.document import Document
from graings.report.metrics_document import Count, Metrics, Seconds

TABLE_FILE: Final = "ablation.json"
MINUS: Final = "\N{MINUS SIGN}"
PLUS_MINUS: Final = "\N{PLUS-MINUS SIGN}"
EMPTY: Final = "\N{EN DASH}"

# Metrics of one row by seed; None where a run is not finished.
Runs = Mapping[int, Metrics | None]


class AblationCapture(Document):
    """The capture of an ablation."""

    name: str = Field(description="Name of its folder.")
    hash: str = Field(description="Hash of its content.")
    views: int = Field(gt=0, description="Validation views.")
    width: int = Field(gt=0, description="Width of a view in px.")
    height: int = Field(gt=0, description="Height of a view in px.")


class AblationCell(Document):
    """One run: null where it is not finished."""

    seed: int = Field(description="Seed of the run.")
    folder: str = Field(description="Folder of the run, relative to the table.")
    finished: bool = Field(description="Whether the run has ended.")
    psnr: float | None = Field(description="Mean PSNR on the validation views, in dB.")
    ssim_3dgs: float | None = Field(description="Mean SSIM on the validation views.")
    lpips_vgg: float | None = Field(description="Mean LPIPS on the validation views; null where it was not measured.")
    difference: float | None = Field(description="`psnr` minus that of the full model of the same seed, in dB.")
    gaussians: Count | None = Field(description="Gaussians drawn in the last step.")
    anchors: Count | None = Field(description="Anchors of the scene.")
    train_s: Seconds | None = Field(description="Seconds of training.")


class Spread(Document):
    """Mean and spread of a number over the finished runs of a row."""

    mean: float | None = Field(description="Mean; null without a finished run.")
    deviation: float | None = Field(description="Sample standard deviation; null with fewer than two runs.")
    runs: Count = Field(description="Runs that have the number.")


class PaperNumbers(Document):
    """What the paper reports for a row: mean over the D-NeRF scenes."""

    psnr: float = Field(description="PSNR in dB.")
    ssim: float = Field(description="SSIM.")
    lpips: float = Field(description="LPIPS.")
    table: str = Field(description="Label of the table in the paper's source.")
    difference: float = Field(description="`psnr` minus that of the paper's full model, in dB.")


class AblationRow(Document):
    """One model of the comparison."""

    name: str = Field(description="Name of the row, as `--rows` takes it.")
    label: str = Field(description="Name of the row for people.")
    changes: dict[str, Any] = Field(description="Options, by dotted name, in which it differs from the full model.")
    runs: tuple[AblationCell, ...] = Field(description="One run per seed.")
    finished: Count = Field(description="How many of the runs have ended.")
    psnr: Spread = Field(description="PSNR in dB.")
    ssim_3dgs: Spread = Field(description="SSIM.")
    difference: Spread = Field(description="Difference to the full model, in dB.")
    gaussians: Spread = Field(description="Gaussians drawn in the last step.")
    train_s: Spread = Field(description="Seconds of training.")
    paper: PaperNumbers | None = Field(description="Null where the paper has no number.")


class PaperSource(Document):
    """Where the paper's numbers are from."""

    source: str = Field(description="Tables and data of the paper's numbers.")


class AblationTable(Document):
    """The runs of one ablation, their means, and the paper's numbers."""

    schema_name: Literal["graings.ablation/1"] = Field(
        "graings.ablation/1", alias="schema", description="Kind and version of this document."
    )
    split: Literal["val"] = Field("val", description="Views that were measured.")
    capture: AblationCapture = Field(description="The capture.")
    options: dict[str, Any] = Field(description="Options of the full model, without seed and threads.")
    changed_options: dict[str, Any] = Field(description="Those that are not the preset's, by dotted name.")
    seeds: tuple[int, ...] = Field(description="Seeds of every row.")
    rows: tuple[AblationRow, ...] = Field(description="The rows, the full model first.")
    paper: PaperSource = Field(description="Where the paper's numbers are from.")
    commits: tuple[str, ...] = Field(description="Commits of the code that trained the runs.")
    machines: tuple[str, ...] = Field(description="Processors that trained the runs.")


def make_table(
    capture: AblationCapture,
    options: Mapping[str, Any],
    changed_options: Mapping[str, Any],
    seeds: Sequence[int],
    rows: Sequence[tuple[Row, Runs]],
) -> AblationTable:
    """The table of `rows`, each with the metrics of its runs."""
    full = next((runs for row, runs in rows if row.name == FULL), {})
    finished = [metrics for _, runs in rows for metrics in runs.values() if metrics is not None]
    return AblationTable(
        capture=capture,
        options=dict(options),
        changed_options=dict(changed_options),
        seeds=tuple(seeds),
        rows=tuple(_row(row, runs, full) for row, runs in rows),
        paper=PaperSource(source=f"GrainGS, tables of the ablation study: {SCENES}"),
        commits=tuple(sorted({metrics.versions.commit for metrics in finished if metrics.versions.commit})),
        machines=tuple(sorted({metrics.machine.cpu for metrics in finished})),
    )


def _row(row: Row, runs: Runs, full: Runs) -> AblationRow:
    cells = tuple(_cell(row, seed, metrics, full.get(seed)) for seed, metrics in runs.items())
    return AblationRow(
        name=row.name,
        label=row.label,
        changes=dict(row.changes),
        runs=cells,
        finished=sum(cell.finished for cell in cells),
        psnr=_spread([cell.psnr for cell in cells]),
        ssim_3dgs=_spread([cell.ssim_3dgs for cell in cells]),
        difference=_spread([cell.difference for cell in cells]),
        gaussians=_spread([cell.gaussians for cell in cells]),
        train_s=_spread([cell.train_s for cell in cells]),
        paper=None if row.paper is None else _paper(row.paper),
    )


def _cell(row: Row, seed: int, metrics: Metrics | None, full: Metrics | None) -> AblationCell:
    val = None if metrics is None else metrics.splits["val"]
    psnr = None if val is None else val.psnr
    full_psnr = None if full is None else full.splits["val"].psnr
    return AblationCell(
        seed=seed,
        folder=f"{row.name}/seed-{seed}",
        finished=metrics is not None,
        psnr=psnr,
        ssim_3dgs=None if val is None else val.ssim_3dgs,
        lpips_vgg=None if val is None else val.lpips_vgg,
        difference=None if psnr is None or full_psnr is None else psnr - full_psnr,
        gaussians=None if metrics is None else metrics.gaussians,
        anchors=None if metrics is None else metrics.anchors,
        train_s=None if metrics is None else metrics.train_s,
    )


def _spread(cells: Sequence[float | None]) -> Spread:
    values = [float(value) for value in cells if value is not None]
    return Spread(
        mean=math.fsum(values) / len(values) if values else None,
        deviation=statistics.stdev(values) if len(values) > 1 else None,
        runs=len(values),
    )


def _paper(result: PaperResult) -> PaperNumbers:
    return PaperNumbers(
        psnr=result.psnr, ssim=result.ssim, lpips=result.lpips, table=result.table, difference=result.difference
    )


def markdown(table: AblationTable) -> str:
    """The document as a page: what was run, the table, and how to read it."""
    capture, options = table.capture, table.options
    changed = "".join(f" `{key}={value}`" for key, value in table.changed_options.items())
    lines = [
        f"# Ablation on {capture.name}",
        "",
        f"{capture.views} validation views of {capture.width} x {capture.height}, preset "
        f"`{options['preset']}`{changed} ({options['iterations']:,} iterations), seeds {_list(table.seeds)}. "
        f"Commit {_list(table.commits)}; {_list(table.machines)}.",
        "",
        "| row | runs | PSNR, dB | SSIM | to full, dB | paper to full, dB | Gaussians | train, min |",
        "|---|---|---|---|---|---|---|---|",
        *(_line(row, len(table.seeds)) for row in table.rows),
        "",
        f"Mean {PLUS_MINUS} sample standard deviation over the seeds. A difference is to the full model of the same "
        f"seed. The paper's numbers are of other data at another length ({table.paper.source}): compare signs and "
        "order before sizes. Deformation per anchor has no number there.",
        "",
    ]
    return "\n".join(lines)


def _line(row: AblationRow, seeds: int) -> str:
    full = row.name == FULL
    cells = [
        row.label,
        f"{row.finished} of {seeds}",
        _number(row.psnr, "{:.2f}"),
        _number(row.ssim_3dgs, "{:.4f}"),
        EMPTY if full else _number(row.difference, "{:+.2f}"),
        EMPTY if row.paper is None or full else signed(row.paper.difference),
        EMPTY if row.gaussians.mean is None else f"{row.gaussians.mean:,.0f}",
        EMPTY if row.train_s.mean is None else f"{row.train_s.mean / 60:.1f}",
    ]
    return f"| {' | '.join(cells)} |"


def signed(decibels: float) -> str:
    """A difference with its sign, the minus as a minus."""
    return f"{decibels:+.2f}".replace("-", MINUS)


def _number(value: Spread, form: str) -> str:
    if value.mean is None:
        return EMPTY
    text = form.format(value.mean).replace("-", MINUS)
    if value.deviation is not None:
        text += f" {PLUS_MINUS} {form.replace('+', '').format(value.deviation)}"
    return text


def _list(values: Sequence[Any]) -> str:
    return ", ".join(map(str, values)) or EMPTY
