"""Rows of the table: what became of the inputs of one kind."""

from __future__ import annotations

from collections import Counter

from pydantic import BaseModel, ConfigDict


class Outcome(BaseModel):
    """What became of one input: `error` is the class of what was raised, `fault` what is wrong with that."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    index: int
    seed: str
    error: str | None = None
    fault: str | None = None
    message: str = ""
    place: str = ""


class Row(BaseModel):
    """The outcomes of one kind of input, and the greatest memory and time of a process that read them."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    kind: str
    inputs: int
    read: int
    refused: int
    faults: int
    peak_mb: int
    slowest_s: float

    @staticmethod
    def of(kind: str, outcomes: list[Outcome], peak_mb: int, slowest_s: float) -> Row:
        faults = sum(outcome.fault is not None for outcome in outcomes)
        read = sum(outcome.fault is None and outcome.error is None for outcome in outcomes)
        return Row(
            kind=kind,
            inputs=len(outcomes),
            read=read,
            refused=len(outcomes) - read - faults,
            faults=faults,
            peak_mb=peak_mb,
            slowest_s=slowest_s,
        )


def table(rows: list[Row]) -> str:
    """The rows as Markdown."""
    lines = [
        "| kind | inputs | read | refused | faults | greatest memory, MB | slowest input, CPU s |",
        "|---|---:|---:|---:|---:|---:|---:|",
    ]
    return "\n".join([*lines, *map(_line, rows)])


def _line(row: Row) -> str:
    outcomes = f"{row.inputs:,} | {row.read:,} | {row.refused:,} | {row.faults:,}"
    return f"| {row.kind} | {outcomes} | {row.peak_mb:,} | {row.slowest_s:.2f} |"


def distinct(outcomes: list[Outcome]) -> list[tuple[Outcome, int]]:
    """One outcome of each fault, by what is wrong and where it was raised, with how many there are."""
    counts = Counter((outcome.fault, outcome.error, outcome.place) for outcome in outcomes if outcome.fault)
    first = {}
    for outcome in outcomes:
        first.setdefault((outcome.fault, outcome.error, outcome.place), outcome)
    return [(first[key], count) for key, count in counts.most_common()]
