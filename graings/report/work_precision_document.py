"""WorkPrecision: error against work of one or more runs, as `work_precision.json` holds it."""

from __future__ import annotations

from typing import Final, Literal

from pydantic import Field

from graings.capture.capture import Split
from graings.document import Document
from graings.evaluation.metrics import SplitMeans
from graings.report.events import Event
from graings.report.machine import MachineFacts, VersionFacts
from graings.report.metrics_document import (
    CaptureFacts,
    Count,
    EvaluationPoint,
    Hashes,
    ModelBytes,
    Seconds,
    Share,
    StiffnessFacts,
)

REPORT_FILE: Final = "work_precision.json"


class TrainedRun(Document):
    """The run of a training part."""

    name: str = Field(description="Shortest end of its path that tells the runs of a report apart.")
    status: Literal["finished", "unfinished"] = Field(description="Whether the run has done all its iterations.")
    preset: str | None = Field(description="Preset of its options; null where the options are unknown.")
    iterations_planned: Count = Field(description="Iterations of the whole run, those before a restart included.")
    seed: int = Field(description="Seed of the random streams.")
    hashes: Hashes = Field(description="What identifies the options and the capture.")


class PhaseTimes(Document):
    """Where the seconds of a run went."""

    seconds: dict[str, Seconds] = Field(description="Seconds per phase.")
    training: tuple[str, ...] = Field(description="Phases that count as training.")
    sum_s: Seconds = Field(description="Sum of all phases.")
    total_s: Seconds = Field(description="Wall-clock seconds of the run.")
    unaccounted_s: float = Field(description="`total_s` minus `sum_s`.")
    unaccounted_share: float = Field(ge=0, description="Its absolute value over `total_s`.")
    tolerance: Share = Field(description="Largest share for which the phases count as consistent.")
    consistent: bool = Field(description="Whether the phases add up to the wall clock.")
    problems: tuple[str, ...] = Field(description="What does not add up, in plain words.")


class Totals(Document):
    """Work of a whole run."""

    train_s: Seconds = Field(description="Wall-clock seconds of training alone.")
    train_cpu_s: Seconds = Field(description="CPU seconds of all threads in `train_s`.")
    evaluation_s: Seconds = Field(description="Seconds of evaluation.")
    checkpoint_s: Seconds = Field(description="Seconds of writing checkpoints.")
    total_s: Seconds = Field(description="Wall-clock seconds of the run.")
    iterations: Count = Field(description="Iterations done.")
    gaussians: Count = Field(description="Gaussians drawn in any view of the last step.")
    anchors: Count = Field(description="Anchors of the scene.")
    bytes: ModelBytes = Field(description="Size of the model.")


class FinalMetrics(SplitMeans):
    """Means over all views of a split at the end of the run."""

    n_views: Count = Field(description="Views of the split.")


class TimeToPsnr(Document):
    """When a quality was first reached: a time, or the bound that is known of it."""

    target_db: float = Field(description="PSNR to reach, in dB.")
    train_s: Seconds | None = Field(None, description="Seconds of training until then; null where not known.")
    iteration: Count | None = Field(None, description="Iteration; null where not known.")
    gaussians: Count | None = Field(None, description="Gaussians at that time; null where not known.")
    censored_at_s: Seconds | None = Field(
        None, description="Not reached in so many seconds of training; null where it was reached."
    )
    at_most_s: Seconds | None = Field(
        None, description="Reached by the first evaluation, after so many seconds of training; null otherwise."
    )
    reason: str | None = Field(None, description="Why there is no time; null where there is one.")


class ErrorFloor(Document):
    """Errors that no model can go below."""

    quantisation_rmse: float = Field(ge=0, description="RMSE of rounding to 8 bits: 1 / (255 sqrt 12).")


class HeldOutReference(Document):
    """What the errors of a training part are measured against."""

    what: str = Field(description="The reference images.")
    psnr: str = Field(description="Definition of `psnr`.")
    rmse: str = Field(description="Definition of `rmse`.")
    floor: ErrorFloor = Field(description="Errors that no model can go below.")


class TrainingPart(Document):
    """Held-out error of one run against seconds, iterations and Gaussians."""

    kind: Literal["training"] = Field("training", description="Kind of this part.")
    run: TrainedRun = Field(description="The run.")
    capture: CaptureFacts = Field(description="The capture that was trained on.")
    machine: MachineFacts = Field(description="Machine of the run.")
    versions: VersionFacts = Field(description="Versions of the run.")
    phases: PhaseTimes = Field(description="Where the seconds went.")
    totals: Totals = Field(description="Work of the whole run.")
    points: tuple[EvaluationPoint, ...] = Field(description="Held-out quality during training, in order.")
    final: dict[Split, FinalMetrics] = Field(description="Means over whole splits; empty before the end of the run.")
    time_to_psnr: tuple[TimeToPsnr, ...] = Field(description="When each target was first reached.")
    events: tuple[Event, ...] = Field(description="What happened beside the ordinary steps, in order.")
    stiffness: StiffnessFacts | None = Field(description="Null before the end of the run.")
    reference: HeldOutReference = Field(description="What the errors are measured against.")


class RenderedRun(Document):
    """The model of a render part."""

    name: str = Field(description="Name of its run in the report.")
    iteration: Count = Field(description="Iteration of the model.")
    finished: bool = Field(description="Whether its run has ended.")
    digest: str = Field(description="Hash of the model.")


class RenderedViews(Document):
    """The views that were rendered."""

    split: Split = Field(description="Split of the views.")
    names: tuple[str, ...] = Field(description="Names of the views.")


class ImageSize(Document):
    """Size of an image."""

    width: int = Field(gt=0, description="Width in px.")
    height: int = Field(gt=0, description="Height in px.")


class RenderReference(Document):
    """What the errors of a render part are measured against."""

    what: str = Field(description="The reference images.")
    alpha_min: float = Field(ge=0, description="Alpha below which the reference leaves a Gaussian out of a pixel.")
    transmittance_min: float = Field(ge=0, description="Transmittance below which the reference ends a pixel.")
    norm: str = Field(description="Definition of the error.")


class RenderSetting(Document):
    """One way to render: one quantity differs from the default."""

    sweep: Literal["default", "resolution", "alpha_min", "transmittance_min"] = Field(
        description="The quantity that differs."
    )
    scale: float = Field(1.0, gt=0, le=1, description="Rendered width and height over the full ones.")
    alpha_min: float = Field(ge=0, description="Alpha below which a Gaussian is left out of a pixel.")
    transmittance_min: float = Field(ge=0, description="Transmittance below which a pixel is finished.")


class Milliseconds(Document):
    """Time of one frame: mean over views, statistics over rounds."""

    median: float = Field(gt=0, description="Whole frame, median over rounds, in ms.")
    min: float = Field(gt=0, description="Whole frame, fastest round, in ms.")
    iqr: float = Field(ge=0, description="Whole frame, interquartile range over rounds, in ms.")
    networks: float = Field(ge=0, description="Median of the networks' part, in ms; the same for all settings.")
    raster: float = Field(ge=0, description="Median of the rasterizer's part, in ms.")


class RenderError(Document):
    """Error of a setting over all pixels of all views."""

    rmse: float = Field(ge=0, description="Root mean square error, values in [0, 1].")
    max: float = Field(ge=0, description="Largest absolute error of any value.")
    psnr_vs_reference: float | None = Field(description="-20 log10 of `rmse`, in dB; null where there is no error.")
    lsb8_changed: Share = Field(description="Share of the values that differ after rounding to 8 bits.")


class RenderPoint(Document):
    """Cost and error of one setting."""

    setting: RenderSetting = Field(description="The setting.")
    ms: Milliseconds = Field(description="Its cost.")
    err: RenderError = Field(description="Its error.")
    on_front: bool = Field(description="Whether no other setting is both faster and closer to the reference.")


class RenderPart(Document):
    """Error of rendering one finished model against the milliseconds of a frame."""

    kind: Literal["render"] = Field("render", description="Kind of this part.")
    run: RenderedRun = Field(description="The model.")
    views: RenderedViews = Field(description="The views that were rendered.")
    size: ImageSize = Field(description="Size of a view.")
    reference: RenderReference = Field(description="What the errors are measured against.")
    rounds: int = Field(gt=0, description="How often every setting was timed.")
    noisy: bool = Field(description="Whether the machine was busy or the times scatter by more than a tenth.")
    load_average: float = Field(ge=0, description="Load average of the machine over the minute before.")
    machine: MachineFacts = Field(description="Machine of the measurement.")
    versions: VersionFacts = Field(description="Versions of the measurement.")
    points: tuple[RenderPoint, ...] = Field(description="Cost and error of every setting.")
    pareto: tuple[int, ...] = Field(description="Indices of the points on the Pareto front, cheapest first.")
    omissions: tuple[str, ...] = Field(description="What this part does not measure, and where it is measured.")


class WorkPrecision(Document):
    """Error against work of one or more runs."""

    schema_name: Literal["graings.work_precision/1"] = Field(
        "graings.work_precision/1", alias="schema", description="Kind and version of this document."
    )
    training: tuple[TrainingPart, ...] = Field(description="One part per run: error while it trained.")
    render: tuple[RenderPart, ...] = Field(description="One part per model that was rendered: error against time.")
    omissions: tuple[str, ...] = Field(description="What the report leaves out, and why.")
