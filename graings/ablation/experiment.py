"""Experiment: the runs of one ablation in one folder, one for each row and seed.

Every run is an ordinary run folder, `FOLDER/row/seed-n`. Which runs are finished is read from those folders each time,
so an interrupted ablation continues where it stopped. The table is rewritten after each run.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from graings.ablation.plot import differences_figure
from graings.ablation.rows import ROWS, Row, chosen_rows, combined, dotted, nothing_to_compare, row_config
from graings.ablation.table import TABLE_FILE, AblationCapture, AblationTable, make_table, markdown
from graings.capture.capture import Capture
from graings.capture.load import load_capture
from graings.config import TrainConfig, make_config
from graings.document import read_document
from graings.errors import CaptureError, CheckpointError, ConfigError
from graings.report.figure_files import png, svg
from graings.report.metrics_document import Metrics, read_metrics
from graings.report.run_record import RunRecord
from graings.storage.files import write_bytes, write_document, write_text
from graings.storage.run_folder import METRICS_FILE, RECORD_FILE
from graings.training.run import TrainingRun

# Options that do not change what is computed, or that an ablation sets for each run.
PER_RUN_OPTIONS: Final = ("seed", "threads")


@dataclass(frozen=True, slots=True)
class AblationRun:
    """One run of the ablation: row and seed, its folder and its options."""

    row: Row
    seed: int
    folder: Path
    config: TrainConfig

    @property
    def finished(self) -> bool:
        """Whether the folder holds the metrics of the last iteration."""
        return _final_metrics(self.folder) is not None

    @property
    def diverged(self) -> bool:
        """Whether it ended because training diverged. Resumed, it may end the same way."""
        file = self.folder / METRICS_FILE
        return file.exists() and read_metrics(file).diverged


class Ablation:
    """The runs of `rows` x `seeds` on one capture under one set of options. Iterating it opens what is unfinished.

    `settings` are the user's options, dotted or nested, beside those that a row sets. Without `rows` all rows that
    differ from the full model under these options are trained; `notes` name the others. More rows and seeds can be
    added to a folder later. Raises `ConfigError` for options (also for a `folder` that was begun with other ones),
    `CaptureError` for a capture without validation views and `CheckpointError` for a folder that holds something else.
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
            # A row that equals the full model is an error only where it was named.
            same = {row.name: nothing_to_compare(row, preset, settings) for row in self.rows}
            self.rows = tuple(row for row in self.rows if same[row.name] is None)
            self.notes = tuple(f"{why} It is left out." for why in same.values() if why is not None)
        self.runs = tuple(
            AblationRun(row, seed, folder / _run_folder(row, seed), row_config(row, preset, settings, seed))
            for seed in self.seeds
            for row in self.rows
        )
        # The options of the full model, which a later call must agree with.
        base = combined(ROWS[0], preset, settings, self.seeds[0])
        self._options = _comparable(base.model_dump(mode="json"))
        self._changed = _changed_from_preset(self._options, base.preset)
        self._path = capture
        self._capture = load_capture(capture, base.capture)
        _check_comparable(self._capture)
        self._shown_rows, self._shown_seeds = self._with_earlier()
        for run in self.runs:
            self._check(run)

    def pending(self) -> tuple[AblationRun, ...]:
        """Runs that are not finished, in the order of training: all rows of a seed, then the next seed.

        Runs that diverged come last, so that none keeps the others from being trained.
        """
        return tuple(sorted((run for run in self.runs if not run.finished), key=lambda run: run.diverged))

    def __iter__(self) -> Iterator[tuple[AblationRun, TrainingRun]]:
        """Each unfinished run, new or resumed, for the caller to iterate; the table is rewritten before and after."""
        self.write()
        for run in self.pending():
            if (run.folder / RECORD_FILE).exists():
                yield run, TrainingRun.resume(run.folder, capture=self._path, threads=self.threads)
            else:
                yield run, TrainingRun.create(self._path, run.folder, run.config)
            self.write()

    def write(self) -> AblationTable:
        """Write ablation.json, .md, .svg and .png from all finished runs; returns the first."""
        self.folder.mkdir(parents=True, exist_ok=True)
        rows = [(row, {seed: self._metrics(row, seed) for seed in self._shown_seeds}) for row in self._shown_rows]
        table = make_table(self._capture_facts(), self._options, self._changed, self._shown_seeds, rows)
        write_document(self.folder / TABLE_FILE, table)
        write_text(self.folder / "ablation.md", markdown(table))
        figure = differences_figure(table.model_dump(mode="json"))
        write_text(self.folder / "ablation.svg", svg(figure))
        write_bytes(self.folder / "ablation.png", png(figure))
        return table

    def _capture_facts(self) -> AblationCapture:
        capture, camera = self._capture, self._capture.val[0].camera
        return AblationCapture(
            name=capture.root.resolve().name,
            hash=capture.content_hash,
            views=len(capture.val),
            width=camera.width,
            height=camera.height,
        )

    def _metrics(self, row: Row, seed: int) -> Metrics | None:
        return _final_metrics(self.folder / _run_folder(row, seed))

    def _with_earlier(self) -> tuple[tuple[Row, ...], tuple[int, ...]]:
        """Rows and seeds of the table: those of this call, and those of an earlier call on the same folder."""
        file = self.folder / TABLE_FILE
        if not file.exists():
            if (self.folder / RECORD_FILE).exists():
                raise CheckpointError(f"{self.folder}: holds a single run. Choose another folder for the ablation.")
            return self.rows, self.seeds
        table = read_document(file, AblationTable, "Delete it; it is written again from the finished runs.")
        if table.capture.hash != self._capture.content_hash:
            raise ConfigError(f"{self.folder}: was begun with another capture. Give that one, or a new folder (-o).")
        _check_same(self.folder, table.options, self._options)
        names = [*(row.name for row in table.rows), *(row.name for row in self.rows)]
        return chosen_rows(names), tuple(sorted({*table.seeds, *self.seeds}))

    def _check(self, run: AblationRun) -> None:
        """Refuse a run folder whose options are not those of its row."""
        file = run.folder / RECORD_FILE
        if not file.exists():
            return
        record = read_document(file, RunRecord, f"Delete {run.folder} to run it again.")
        if record.capture.hash != self._capture.content_hash:
            raise ConfigError(f"{run.folder}: was begun with another capture. Give that one, or a new folder (-o).")
        begun, wanted = (_comparable(config.model_dump(mode="json")) for config in (record.config, run.config))
        _check_same(run.folder, begun, wanted)


def _run_folder(row: Row, seed: int) -> str:
    return f"{row.name}/seed-{seed}"


def _final_metrics(run: Path) -> Metrics | None:
    """The metrics of a run that has ended, else None.

    A run that was interrupted or diverged may have splits too, but they are not those of its row.
    """
    file = run / METRICS_FILE
    if not file.exists():
        return None
    metrics = read_metrics(file)
    ended = metrics.iterations >= metrics.iterations_planned and not metrics.diverged
    return metrics if ended and "val" in metrics.splits else None


def _check_comparable(capture: Capture) -> None:
    """Refuse a capture on which the rows would not differ, before hours are spent on it."""
    if not capture.val:
        raise CaptureError(
            "has no validation views, and models must not be compared on test views",
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
    return {key: value for key, value in options.items() if key not in PER_RUN_OPTIONS}


def _changed_from_preset(options: Mapping[str, Any], preset: str) -> dict[str, Any]:
    """The options, by dotted name, that are not those of the preset."""
    defaults = dotted(make_config(preset).model_dump(mode="json"))
    return {key: value for key, value in dotted(options).items() if defaults[key] != value}


def _check_same(folder: Path, begun: Mapping[str, Any], wanted: Mapping[str, Any]) -> None:
    """Raise `ConfigError` naming the options that differ."""
    before, now = dotted(begun), dotted(wanted)
    different = [key for key in {**before, **now} if before.get(key) != now.get(key)]
    if different:
        changes = ", ".join(f"{key} was {before.get(key)!r} and is now {now.get(key)!r}" for key in different)
        raise ConfigError(
            f"{folder}: was begun with other options: {changes}. "
            "Give the same options to continue it, or choose a new folder (-o)."
        )
