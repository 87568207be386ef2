"""A model over time: flicker where nothing moves, and error between training times.

    python benchmarks/temporal.py RUN... -o FOLDER [--frames 100] [--view 0]

Flicker: one held-out camera is fixed while time runs through [0, 1]. A pixel is at rest if the object covers it at
every time and the moving average over five frames varies by at most 4 levels of 255. Flicker is the deviation of the
frames from that average, as RMS and maximum in levels. No ground truth exists for one camera at all times, so this
measures steadiness and not error.

Error between frames: PSNR of training views, and of held-out views by their distance from the nearest training time in
steps of the training spacing; 0 is a held-out view at a training time (to a hundredth of a step).

Prints a row for each run and writes FOLDER/temporal.json and, for each run, FOLDER/NAME.png: 24 frames of the clip.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib import image

from graings.capture.capture import Frame
from graings.capture.images import ImageStore
from graings.capture.load import load_capture
from graings.evaluation.evaluate import evaluate, subset
from graings.render import PreparedScene, render
from graings.storage.checkpoint import load_model
from graings.storage.model import Model

REST_LEVELS = 4.0
WINDOW = 5
SHOWN = (4, 6)


def clip(model: Model, view: int, frames: int) -> tuple[np.ndarray, np.ndarray]:
    """(colors [T, H, W, 3] in [0, 1], alphas [T, H, W]) of one held-out camera at `frames` times over [0, 1]."""
    camera = model.views["val"][view].camera
    scene = PreparedScene(model.scene)
    results = [render(scene, camera, float(t), model.background) for t in np.linspace(0, 1, frames)]
    colors = np.stack([result.color.clamp(0, 1).numpy() for result in results])
    return colors, np.stack([result.alpha.numpy().reshape(colors.shape[1:3]) for result in results])


def flicker(colors: np.ndarray, alphas: np.ndarray) -> dict[str, float | None]:
    """Share of covered pixels at rest, and their RMS and largest deviation from the moving average in levels of 255."""
    half = WINDOW // 2
    sums = np.cumsum(np.concatenate([np.zeros_like(colors[:1]), colors], dtype=np.float64), axis=0)
    slow = (sums[WINDOW:] - sums[:-WINDOW]) / WINDOW
    covered = (alphas >= 0.5).all(axis=0)
    rests = covered & (255 * np.ptp(slow, axis=0).max(axis=-1) <= REST_LEVELS)
    fast = 255 * (colors[half:-half] - slow)[:, rests]
    return {
        "resting_share": float(rests.sum() / max(1, covered.sum())),
        "rms_levels": float(np.sqrt((fast**2).mean())) if rests.any() else None,
        "max_levels": float(np.abs(fast).max()) if rests.any() else None,
    }


def error_in_time(run: Path, model: Model) -> dict[str, Any]:
    """Mean PSNR in dB of training views and, by steps to the nearest training time, of held-out views; how many."""
    root = json.loads((run / "run.json").read_text())["capture"]["path"]
    capture = load_capture(Path(root), model.config.capture)
    images = ImageStore(model.background, model.config.capture.cache_mb)
    times = np.unique([frame.time for frame in capture.train])
    spacing = float(np.median(np.diff(times))) if len(times) > 1 else 1.0

    apart: dict[int, list[Frame]] = {}
    for frame in capture.val:
        steps = float(np.abs(times - frame.time).min()) / spacing
        apart.setdefault(0 if steps <= 0.01 else max(1, round(steps)), []).append(frame)

    def psnr(frames: Sequence[Frame]) -> float:
        return evaluate(model.scene, frames, images, model.background).psnr

    return {
        "spacing": spacing,
        "train": psnr(subset(capture.train, 40)),
        "held_out": {steps: {"psnr": psnr(apart[steps]), "views": len(apart[steps])} for steps in sorted(apart)},
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, nargs="+")
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--frames", type=int, default=100)
    parser.add_argument("--view", type=int, default=0)
    options = parser.parse_args()

    if len({run.name for run in options.runs}) < len(options.runs):
        parser.error("two of the runs have the same folder name, which names their row and image: rename one")
    models = {run: load_model(run) for run in options.runs}
    for run, model in models.items():
        if options.view not in range(len(model.views["val"])):
            parser.error(
                f"{run}: has no validation view {options.view}: give another --view, or a capture with a val split"
            )
    options.output.mkdir(parents=True, exist_ok=True)
    torch.set_grad_enabled(False)
    document = {}
    for run, model in models.items():
        colors, alphas = clip(model, options.view, options.frames)
        document[run.name] = {**flicker(colors, alphas), **error_in_time(run, model)}
        chosen = colors[np.linspace(0, len(colors) - 1, SHOWN[0] * SHOWN[1]).round().astype(int)]
        rows = [np.concatenate(list(row), axis=1) for row in chosen.reshape(*SHOWN, *chosen.shape[1:])]
        image.imsave(options.output / f"{run.name}.png", np.concatenate(rows)[::2, ::2])
        print(run.name, json.dumps(document[run.name]), flush=True)
    (options.output / "temporal.json").write_text(json.dumps(document, indent=1, allow_nan=False) + "\n")


if __name__ == "__main__":
    main()
