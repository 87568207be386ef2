"""Table: the numbers of an ablation as one document, and that document as a page of markdown.

Differences are to the full model of the same seed, so that what a seed does to both cancels. Knows nothing of how runs
are made; it is told their metrics documents.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any, Final

from graings.ablation.rows import FULL, SCENES, PaperResult, Row

SCHEMA: Final = "graings.ablation/1"
MINUS: Final = "\N{MINUS SIGN}"
NOTHING: Final = "\N{EN DASH}"

# Metrics documents of one row by seed; None where a run is not finished.
Runs = Mapping[int, Mapping[str, Any] | None]


def document(facts: Mapping[str, Any], rows: Sequence[tuple[Row, Runs]]) -> dict[str, Any]:
    """The table as plain values for strict JSON: `facts`, and for each row its runs, their means and the paper's.

    PSNR and differences are in dB, times in seconds. What is not measured yet is null.
    """
    full = next((runs for row, runs in rows if row.name == FULL), {})
    return {
        "schema": SCHEMA,
        "split": "val",
        **facts,
        "rows": [_row(row, runs, full) for row, runs in rows],
        "paper": {"source": f"GrainGS, tables of the ablation study: {SCENES}"},
        "commits": sorted({str(m["versions"]["commit"]) for _, runs in rows for m in runs.values() if m}),
        "machines": sorted({str(m["machine"]["cpu"]) for _, runs in rows for m in runs.values() if m}),
    }


def _row(row: Row, runs: Runs, full: Runs) -> dict[str, Any]:
    cells = [_run(row, seed, numbers, full.get(seed)) for seed, numbers in runs.items()]
    return {
        "name": row.name,
        "label": row.label,
        "changes": dict(row.changes),
        "runs": cells,
        "finished": sum(cell["finished"] for cell in cells),
        "psnr": _spread(cells, "psnr"),
        "ssim_3dgs": _spread(cells, "ssim_3dgs"),
        "difference": _spread(cells, "difference"),
        "gaussians": _spread(cells, "gaussians"),
        "train_s": _spread(cells, "train_s"),
        "paper": _paper(row.paper),
    }


def _run(row: Row, seed: int, numbers: Mapping[str, Any] | None, full: Mapping[str, Any] | None) -> dict[str, Any]:
    cell: dict[str, Any] = {"seed": seed, "folder": f"{row.name}/seed-{seed}", "finished": numbers is not None}
    val = numbers["splits"]["val"] if numbers is not None else {}
    base = full["splits"]["val"]["psnr"] if full is not None else None
    return cell | {
        "psnr": val.get("psnr"),
        "ssim_3dgs": val.get("ssim_3dgs"),
        "lpips_vgg": val.get("lpips_vgg"),
        "difference": val["psnr"] - base if val and base is not None else None,
        **{key: numbers[key] if numbers is not None else None for key in ("gaussians", "anchors", "train_s")},
    }


def _spread(cells: Sequence[Mapping[str, Any]], key: str) -> dict[str, Any]:
    """Mean over the runs that have the number, and its sample standard deviation where there are two or more."""
    values = [float(cell[key]) for cell in cells if cell[key] is not None]
    return {
        "mean": math.fsum(values) / len(values) if values else None,
        "deviation": statistics.stdev(values) if len(values) > 1 else None,
        "runs": len(values),
    }


def _paper(result: PaperResult | None) -> dict[str, Any] | None:
    return None if result is None else {**asdict(result), "difference": result.difference}


def markdown(table: Mapping[str, Any]) -> str:
    """The document as a page: what was run, the table, and how to read it."""
    capture, options = table["capture"], table["options"]
    changed = "".join(f" `{key}={value}`" for key, value in table["changed_options"].items())
    lines = [
        f"# Ablation on {capture['name']}",
        "",
        f"{capture['views']} validation views of {capture['width']} x {capture['height']}, preset "
        f"`{options['preset']}`{changed} ({options['iterations']:,} iterations), seeds {_list(table['seeds'])}. "
        f"Commit {_list(table['commits'])}; {_list(table['machines'])}.",
        "",
        "| row | runs | PSNR, dB | SSIM | to full, dB | paper to full, dB | Gaussians | train, min |",
        "|---|---|---|---|---|---|---|---|",
        *(_line(row, len(table["seeds"])) for row in table["rows"]),
        "",
        f"Mean {_SIGN} sample standard deviation over the seeds. A difference is to the full model of the same seed. "
        f"The paper's numbers are of other data at another length ({table['paper']['source']}): compare signs and "
        "order before sizes. Deformation per anchor has no number there.",
        "",
    ]
    return "\n".join(lines)


_SIGN: Final = "\N{PLUS-MINUS SIGN}"


def _line(row: Mapping[str, Any], seeds: int) -> str:
    minutes = {
        key: value / 60 if key != "runs" and value is not None else value for key, value in row["train_s"].items()
    }
    full = row["name"] == FULL
    paper = row["paper"]
    cells = [
        row["label"],
        f"{row['finished']} of {seeds}",
        _number(row["psnr"], "{:.2f}"),
        _number(row["ssim_3dgs"], "{:.4f}"),
        NOTHING if full else _number(row["difference"], "{:+.2f}"),
        NOTHING if paper is None or full else signed(paper["difference"]),
        _number({**row["gaussians"], "deviation": None}, "{:,.0f}"),
        _number({**minutes, "deviation": None}, "{:.1f}"),
    ]
    return f"| {' | '.join(cells)} |"


def signed(decibels: float) -> str:
    """A difference with its sign, the minus as a minus."""
    return f"{decibels:+.2f}".replace("-", MINUS)


def _number(value: Mapping[str, Any], form: str) -> str:
    if value["mean"] is None:
        return NOTHING
    text = form.format(value["mean"]).replace("-", MINUS)
    if value["deviation"] is not None:
        text += f" {_SIGN} {form.replace('+', '').format(value['deviation'])}"
    return text


def _list(values: Sequence[Any]) -> str:
    return ", ".join(map(str, values)) or NOTHING
