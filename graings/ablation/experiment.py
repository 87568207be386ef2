"""Experiment: the runs of one ablation in one folder, one for each row and seed.

Every run is an ordinary run folder, `FOLDER/row/seed-n`. Which runs are finished is read from those folders each time,
so an ablation that was interrupted goes on where it stood. The table is rewritten after each run. Knows nothing of
terminals, and nothing of how a table looks.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from graings.ablation.plot import differences_figure
from graings.ablation.rows import ROWS, Row, chosen_rows, combined, nothing_to_compare, row_config
from graings.ablation.table import SCHEMA, document, markdown
from graings.capture.capture import Capture
from graings.capture.load import load_capture
from graings.config import TrainConfig, make_config
from graings.errors import CaptureError, CheckpointError, ConfigError
from graings.report.figure_files import png, svg
from graings.report.report import read_metrics, write_bytes, write_metrics, write_text
from graings.training.run import TrainingRun

TABLE: Final = "ablation.json"

# Options that do not change what is computed, or that an ablation sets for each run.
OWN: Final = ("seed", "threads")


@dataclass(frozen=True, slots=True)
class AblationRun:
    """One run still to be done: the row and seed, where it lies, and its options."""

    row: Row
    seed: int
    folder: Path
    config: TrainConfig

    @property
    def finished(self) -> bool:
        """Whether the folder holds the numbers of the last iteration."""
        return _numbers(self.folder, self.config.iterations) is not None


class Ablation:
    """The runs of `rows` x `seeds` on one capture under one set of options. Iterating it opens what is unfinished.

    `settings` are the user's options, dotted or nested, beside what a row demands. Raises `ConfigError` for options
    (also: for a `folder` that was begun with others), `CaptureError` for a capture without validation views and
    `CheckpointError` for a folder that holds something else. A folder may be asked for more rows and seeds later.
    Without `rows` it is all that differ from the full model under these options; `notes` say which do not.
    """

    def __init__(
        self,
        folder: Path,
        capture: Path,
        *,
        preset: str = "standard",
        settings: Mapping[str, Any] | None = None,
        rows: Sequence[str] = (),
        seeds: Sequence[int] = (0, 1, 2),
        threads: int | None = None,
    ) -> None:
        if not seeds:
            raise ConfigError("seeds: none given. One is enough for differences, three for their spread.")
        settings = dict(settings or {})
        self.folder = folder
        self.threads = threads
        self.seeds = tuple(dict.fromkeys(seeds))
        if threads is not None:
            settings["threads"] = threads
        self.rows, self.notes = chosen_rows(rows), tuple[str, ...]()
        if not rows:
            # Who names no row wants those that say something.
            same = {row.name: nothing_to_compare(row, preset, settings) for row in self.rows}
            self.rows = tuple(row for row in self.rows if same[row.name] is None)
            self.notes = tuple(f"{why} It is left out." for why in same.values() if why is not None)
        self.runs = tuple(
            AblationRun(row, seed, folder / _place(row, seed), row_config(row, preset, settings, seed))
            for seed in self.seeds
            for row in self.rows
        )
        # The options that all rows share, as the full model states them: what a later call must agree with.
        base = combined(ROWS[0], preset, settings, self.seeds[0])
        self._options = _comparable(base.model_dump(mode="json"))
        self._changed = _beside_preset(self._options, base.preset)
        self._path = capture
        self._capture = load_capture(capture, base.capture)
        _measurable(self._capture)
        self._shown_rows, self._shown_seeds = self._earlier()
        for job in self.runs:
            self._check(job)

    def pending(self) -> tuple[AblationRun, ...]:
        """Runs that are not finished, in the order in which they are taken: all rows of a seed, then the next seed."""
        return tuple(job for job in self.runs if not job.finished)

    def __iter__(self) -> Iterator[tuple[AblationRun, TrainingRun]]:
        """Each unfinished run, new or resumed, for the caller to iterate; the table is rewritten before and after."""
        self.write()
        for job in self.pending():
            if (job.folder / "run.json").exists():
                yield job, TrainingRun.resume(job.folder, capture=self._path, threads=self.threads)
            else:
                yield job, TrainingRun.create(self._path, job.folder, job.config)
            self.write()

    def write(self) -> dict[str, Any]:
        """Write ablation.json, .md, .svg and .png from all finished runs; returns the first."""
        self.folder.mkdir(parents=True, exist_ok=True)
        rows = [(row, {seed: self._of(row, seed) for seed in self._shown_seeds}) for row in self._shown_rows]
        table = document(self._facts(), rows)
        write_metrics(self.folder / TABLE, table)
        write_text(self.folder / "ablation.md", markdown(table))
        figure = differences_figure(table)
        write_text(self.folder / "ablation.svg", svg(figure))
        write_bytes(self.folder / "ablation.png", png(figure))
        return table

    def _facts(self) -> dict[str, Any]:
        capture, camera = self._capture, self._capture.val[0].camera
        return {
            "capture": {
                "name": capture.root.resolve().name,
                "hash": capture.content_hash,
                "views": len(capture.val),
                "width": camera.width,
                "height": camera.height,
            },
            "options": self._options,
            "changed_options": self._changed,
            "seeds": list(self._shown_seeds),
        }

    def _of(self, row: Row, seed: int) -> dict[str, Any] | None:
        return _numbers(self.folder / _place(row, seed), self._options["iterations"])

    def _earlier(self) -> tuple[tuple[Row, ...], tuple[int, ...]]:
        """Rows and seeds of the table: those of this call, and those that an earlier one left in the folder."""
        file = self.folder / TABLE
        if not file.exists():
            if (self.folder / "run.json").exists():
                raise CheckpointError(f"{self.folder}: holds a single run. Choose another folder for the ablation.")
            return self.rows, self.seeds
        try:
            table = json.loads(file.read_text(encoding="utf-8"))
            schema, options, hash = table["schema"], table["options"], table["capture"]["hash"]
            names, seeds = [row["name"] for row in table["rows"]], [int(seed) for seed in table["seeds"]]
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise CheckpointError(
                f"{file}: not readable ({error!r}). Delete it; it is written anew from the finished runs."
            ) from error
        if schema != SCHEMA:
            raise CheckpointError(f"{file}: is {schema}, not {SCHEMA}. Use the version that wrote it, or a new folder.")
        if hash != self._capture.content_hash:
            raise ConfigError(f"{self.folder}: was begun with another capture. Give that one, or a new folder (-o).")
        _refuse(self.folder, options, self._options)
        names += [row.name for row in self.rows]
        return chosen_rows(names), tuple(sorted({*seeds, *self.seeds}))

    def _check(self, job: AblationRun) -> None:
        """Refuse a run folder whose options are not this row's: its number would stand in the wrong line."""
        file = job.folder / "run.json"
        if not file.exists():
            return
        try:
            facts = json.loads(file.read_text(encoding="utf-8"))
            options, hash = facts["config"], facts["capture"]["hash"]
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise CheckpointError(f"{file}: not readable ({error!r}). Delete {job.folder} to run it again.") from error
        if hash != self._capture.content_hash:
            raise ConfigError(f"{job.folder}: was begun with another capture. Give that one, or a new folder (-o).")
        _refuse(job.folder, _comparable(options), _comparable(job.config.model_dump(mode="json")))


def _place(row: Row, seed: int) -> str:
    return f"{row.name}/seed-{seed}"


def _numbers(run: Path, iterations: int) -> dict[str, Any] | None:
    """The metrics document of a run that is finished, else None: before the end it has no split.

    A run that began again has more than `iterations`; one that diverged has splits, and its numbers are not the row's.
    """
    file = run / "metrics.json"
    if not file.exists():
        return None
    numbers = read_metrics(file)
    ended = numbers["iterations"] >= iterations and not numbers.get("diverged", False)
    return numbers if ended and "val" in numbers["splits"] else None


def _measurable(capture: Capture) -> None:
    """Refuse a capture on which the rows could not be told apart, before hours are spent on it."""
    if not capture.val:
        raise CaptureError(
            "has no validation views, and test views are not for comparing models",
            file=capture.root,
            remedy="Give it a validation split (transforms_val.json).",
        )
    if len(capture.times) < 2:
        raise CaptureError(
            "shows a single instant, so the rows would all be the same static model",
            file=capture.root,
            remedy="Choose a capture in which something moves.",
        )


def _comparable(options: Mapping[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in options.items() if key not in OWN}


def _beside_preset(options: Mapping[str, Any], preset: str) -> dict[str, Any]:
    """The dotted options that are not those of the preset."""
    usual = _dotted(make_config(preset).model_dump(mode="json"))
    return {key: value for key, value in _dotted(options).items() if usual[key] != value}


def _dotted(options: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in options.items():
        flat |= _dotted(value, f"{prefix}{key}.") if isinstance(value, Mapping) else {f"{prefix}{key}": value}
    return flat


def _refuse(folder: Path, then: Mapping[str, Any], now: Mapping[str, Any]) -> None:
    before, after = _dotted(then), _dotted(now)
    different = [key for key in {**before, **after} if before.get(key) != after.get(key)]
    if different:
        words = ", ".join(f"{key} was {before.get(key)!r} and is now {after.get(key)!r}" for key in different)
        raise ConfigError(
            f"{folder}: was begun with other options: {words}. "
            "Give the same options to continue it, or choose a new folder (-o)."
        )
