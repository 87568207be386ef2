"""Metrics: the numbers of one run, as `metrics.json` holds them."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from graings.capture.capture import Split
from graings.config import TrainConfig
from graings.document import Document, read_document
from graings.evaluation.metrics import PSNR_CAP, SplitMetrics
from graings.evaluation.motion import MotionMetrics
from graings.plan.plan import Plan
from graings.report.events import Event
from graings.report.machine import MachineFacts, VersionFacts
from graings.report.start_events import Channel

Seconds = Annotated[float, Field(ge=0)]
Count = Annotated[int, Field(ge=0)]
Share = Annotated[float, Field(ge=0, le=1)]


class EvaluationPoint(Document):
    """Quality on held-out views at one moment of training."""

    iteration: Count = Field(description="Iterations done.")
    train_s: Seconds = Field(description="Wall-clock seconds of training alone: no evaluation, checkpoint or loading.")
    train_cpu_s: Seconds = Field(description="CPU seconds of all threads in `train_s`.")
    total_s: Seconds = Field(description="Seconds of everything measured so far, evaluation and checkpoints included.")
    psnr: float = Field(le=PSNR_CAP, description="Mean PSNR over the views, in dB.")
    rmse: float = Field(ge=0, le=1, description="Root of the mean squared error over all views, values in [0, 1].")
    ssim_3dgs: float = Field(ge=-1, le=1, description="Mean structural similarity, as 3D Gaussian Splatting has it.")
    views: int = Field(gt=0, description="Held-out views that were drawn.")
    gaussians: Count = Field(description="Gaussians drawn in any view of the last step.")
    anchors: Count = Field(description="Anchors of the scene.")
    step_over_size: float | None = Field(
        ge=0,
        description="Length of the last measured optimiser step over the size of the Gaussian it moved, 99th "
        "percentile; null where nothing was measured.",
    )
    subpixel_share: Share | None = Field(
        description="Share of the Gaussians seen in the views of the evaluation whose footprint is below a tenth of a "
        "pixel in all of them; null where none is seen."
    )


class StiffnessFacts(Document):
    """Whether the last optimiser steps fitted the scene; measured on all training views at the end."""

    step_over_size: float | None = Field(
        ge=0,
        description="Length of the last measured step over the size of the Gaussian it moved, 99th percentile; null "
        "where nothing was measured.",
    )
    subpixel_share: Share | None = Field(
        description="Share of the Gaussians seen in the training views whose footprint stays below a tenth of a pixel "
        "in all of them; null where none is seen."
    )
    views: Count = Field(description="Training views that were looked at.")
    stiff: bool = Field(description="Whether `step_over_size` is above 1.")


class ModelBytes(Document):
    """Size of the trained model."""

    fp32: Count = Field(description="Bytes of all parameters in float32.")
    compact: Count | None = Field(description="Bytes of the compact file; null before the run has ended.")


class CompactFacts(Document):
    """The compact file of the model."""

    file: str = Field(description="Its name in the run folder.")
    bytes: int = Field(gt=0, description="Its size in bytes.")
    psnr: float | None = Field(
        le=PSNR_CAP,
        description="Mean PSNR on all validation views, in dB, of the model read from it; null without any.",
    )


class CaptureFacts(Document):
    """The capture of a run."""

    frames: dict[Split, Count] = Field(description="Images per split.")
    times: int = Field(gt=0, description="Distinct training times.")
    width: int = Field(gt=0, description="Width in px of the first training image, as it is trained on.")
    height: int = Field(gt=0, description="Height in px of the first training image, as it is trained on.")
    background: tuple[Channel, Channel, Channel] = Field(description="Colour behind the scene, RGB in [0, 1].")
    notes: tuple[str, ...] = Field(description="What the reader of the capture left out or assumed, in plain words.")


class Hashes(Document):
    """What identifies the options and the capture."""

    config: str = Field(description="sha256 of the options as canonical JSON.")
    capture: str = Field(description="Hash of the capture's content.")


class Metrics(Document):
    """Numbers of one run; written after every evaluation and complete when the run has ended."""

    schema_name: Literal["graings.metrics/1"] = Field(
        "graings.metrics/1", alias="schema", description="Kind and version of this document."
    )
    splits: dict[Split, SplitMetrics] = Field(description="Metrics of whole splits; empty before the run has ended.")
    motion: MotionMetrics | None = Field(
        None, description="Error of tracked points; null unless the capture has trajectories and was evaluated."
    )
    train_s: Seconds = Field(description="Wall-clock seconds of training alone: no evaluation, checkpoint or loading.")
    train_cpu_s: Seconds = Field(description="CPU seconds of all threads in `train_s`.")
    total_s: Seconds = Field(description="Sum of `phases_s`.")
    wall_s: Seconds = Field(description="Wall-clock seconds of the run, interruptions left out.")
    phases_s: dict[str, Seconds] = Field(description="Seconds per phase: load, init, warmup, joint, evaluation, ...")
    iterations: Count = Field(description="Iterations done, those before a restart included.")
    iterations_planned: Count = Field(description="Iterations of the whole run; a restart adds those before it.")
    gaussians: Count = Field(description="Gaussians drawn in any view of the last step.")
    anchors: Count = Field(description="Anchors of the scene.")
    bytes: ModelBytes = Field(description="Size of the model.")
    compact: CompactFacts | None = Field(description="The compact file; null before the run has ended.")
    render_fps: float | None = Field(
        gt=0, description="Frames per second of the newest evaluation, median over its views; null before the first."
    )
    curve: tuple[EvaluationPoint, ...] = Field(description="Held-out quality during training, in order.")
    events: tuple[Event, ...] = Field(description="What happened beside the ordinary steps, in order.")
    plan: Plan = Field(description="Components that this scene does not need.")
    capture: CaptureFacts = Field(description="The capture that was trained on.")
    skipped_steps: Count = Field(description="Steps left out because the loss or a gradient was not finite.")
    clipped_steps: Count = Field(description="Steps of which some gradients were scaled down.")
    rollbacks: Count = Field(description="How often training returned to an earlier state.")
    stiffness: StiffnessFacts | None = Field(description="Null before the run has ended.")
    diverged: bool = Field(description="Whether training gave up; the model is then the best one before.")
    diverged_reason: str | None = Field(description="Why training gave up; null where it did not.")
    machine: MachineFacts = Field(description="Machine of the last start of the run.")
    versions: VersionFacts = Field(description="Versions of the last start of the run.")
    seed: int = Field(description="Seed of the random streams.")
    hashes: Hashes = Field(description="What identifies the options and the capture.")


def read_metrics(path: Path) -> Metrics:
    """The metrics in a file. Raises `CheckpointError` naming the file and the first field that does not fit."""
    return read_document(path, Metrics, "Finish the training run (graings train --resume), or train again.")


def config_hash(config: TrainConfig) -> str:
    """sha256 over the canonical JSON of a configuration."""
    canonical = json.dumps(config.model_dump(mode="json"), sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(canonical.encode()).hexdigest()
