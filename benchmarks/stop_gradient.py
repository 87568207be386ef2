"""What the stop-gradient of Eq. 7 blocks: the gradient from DeformNet to the canonical positions, over training.

    python benchmarks/stop_gradient.py CAPTURE -o FOLDER [--preset paper] [--set KEY=VALUE ...] [--every 500]
    python benchmarks/stop_gradient.py CAPTURE -o FOLDER --plot docs/quality/stop_gradient.svg

Trains the rows `full` and `no_stop_gradient` of an ablation in FOLDER, which `graings ablate` can continue. Every
so many steps, on the same eight training views, it takes the gradient of L_pho with respect to the positions of the
anchors, once with and once without the stop-gradient. The first is the direct gradient, the difference is what the
stop-gradient blocks. An anchor moves its ten children, so its gradient is the sum of theirs. Both are exact: the images
are the same. Drift is how far the canonical positions of children have moved since the end of the warm-up, in units of
the scene's extent, over the more opaque half of those that were drawn then; anchors are found again by their numbers.

Measurements go to FOLDER/ROW/seed-0/stop_gradient.jsonl, one line for each. A resumed run measures on; lines beyond its
checkpoint are replaced.
"""

from __future__ import annotations

import argparse
import json
import statistics
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from graings.ablation.experiment import Ablation
from graings.capture.capture import Frame
from graings.evaluation.evaluate import subset
from graings.raster.photometric import photometric
from graings.render import draw
from graings.report.axes import new_page, new_panel
from graings.report.figure_files import style, svg
from graings.scene.scene import Scene
from graings.training.run import TrainingRun

ROWS = ("full", "no_stop_gradient")
LABELS = {"full": "with stop-gradient", "no_stop_gradient": "without stop-gradient"}
COLORS = {"full": "#0072b2", "no_stop_gradient": "#d55e00"}
VIEWS = 8
FILE = "stop_gradient.jsonl"


def position_gradient(run: TrainingRun, frame: Frame, stop: bool) -> Tensor:
    """Gradient [A, 3] of L_pho of one view with respect to the anchors' positions, float64."""
    scene, config = run.trainer.scene, run.trainer.scene.config
    anchors = scene.scaffold.anchors
    scene.config = config.model_copy(update={"stop_gradient": stop})
    try:
        composition = scene.compose(frame.camera.center, frame.time)
        result = draw(composition, frame.camera, run.trainer.background)
        loss = photometric(result.color, torch.from_numpy(run.images.rgb(frame)), run.config.loss.ssim, 0.0)
        (gradient,) = torch.autograd.grad(loss, anchors)
    finally:
        scene.config = config
    return gradient.double()


def canonical_positions(scene: Scene) -> tuple[Tensor, Tensor]:
    """x_can [A, k, 3] of all children, and the unique numbers [A] of their anchors."""
    scaffold = scene.scaffold
    offsets = scaffold.log_scales.detach().exp()[:, None] * scaffold.offsets.detach()
    return scaffold.anchors.detach()[:, None] + offsets, scaffold.uids


class Drift:
    """How far children have moved since the end of the warm-up."""

    def __init__(self, scene: Scene, eye: Any, time: float) -> None:
        self.start, self.uids = canonical_positions(scene)
        composition = scene.compose(eye, time)
        opacities = composition.gaussians.opacities.detach().flatten()
        opaque = composition.children[opacities >= opacities.median()]
        self.opaque = torch.zeros(self.start.shape[:2], dtype=torch.bool).flatten()
        self.opaque[opaque] = True
        self.opaque = self.opaque.reshape(self.start.shape[:2])

    def of(self, scene: Scene) -> dict[str, float]:
        """Median, 90th percentile and root mean square over the children that are still there, of the extent."""
        now, uids = canonical_positions(scene)
        row = {uid: i for i, uid in enumerate(uids.tolist())}
        kept = [i for i, uid in enumerate(self.uids.tolist()) if uid in row]
        here = now[[row[int(self.uids[i])] for i in kept]]
        moved = (here - self.start[kept]).norm(dim=-1)[self.opaque[kept]] / float(scene.extent)
        return {
            "drift_median": float(moved.median()),
            "drift_p90": float(moved.quantile(0.9)),
            "drift_rms": float(moved.square().mean().sqrt()),
        }


def measure(run: TrainingRun, frames: Sequence[Frame], drift: Drift) -> dict[str, float]:
    """Norms of the direct and the blocked gradient (means over the views), their cosine, and the drift."""
    direct, blocked, cosines = [], [], []
    for frame in frames:
        with_stop, without = position_gradient(run, frame, True), position_gradient(run, frame, False)
        difference = without - with_stop
        direct.append(float(with_stop.norm()))
        blocked.append(float(difference.norm()))
        if direct[-1] > 0 and blocked[-1] > 0:
            cosines.append(float((with_stop * difference).sum()) / (direct[-1] * blocked[-1]))
    return {
        "iteration": run.iteration,
        "direct": statistics.mean(direct),
        "blocked": statistics.mean(blocked),
        "cosine": statistics.mean(cosines) if cosines else 0.0,
        "anchors": run.trainer.scene.scaffold.count,
        **drift.of(run.trainer.scene),
    }


def train(run: TrainingRun, every: int) -> None:
    """Train a run to its end and write its measurements."""
    file, start = run.folder / FILE, run.folder / "stop_gradient_start.pt"
    known = [json.loads(line) for line in file.read_text().splitlines()] if file.exists() else []
    file.write_text("".join(json.dumps(line) + "\n" for line in known if line["iteration"] <= run.iteration))
    frames = subset(run.capture.train, VIEWS)
    drift = torch.load(start, weights_only=False) if start.exists() else None
    for report in run:
        if drift is None and report.phase != "warmup":
            drift = Drift(run.trainer.scene, frames[0].camera.center, frames[0].time)
            torch.save(drift, start)
        if drift is not None and report.iteration % every == 0:
            numbers = measure(run, frames, drift)
            with file.open("a") as stream:
                stream.write(json.dumps(numbers) + "\n")
        if report.evaluation is not None:
            print(f"{run.folder.parent.name}  {report.iteration:,}  {report.evaluation.psnr:.2f} dB", flush=True)


def figure(folder: Path, seed: int) -> str:
    """The plot: norms, cosine and drift against the iteration, as SVG."""
    curves = {}
    for row in ROWS:
        file = folder / row / f"seed-{seed}" / FILE
        lines = [json.loads(line) for line in file.read_text().splitlines()] if file.exists() else []
        if lines:
            curves[row] = {key: [line[key] for line in lines] for key in lines[0]}
    if not curves:
        raise SystemExit(f"{folder}: holds no measurement. Train first (leave out --plot).")
    with style():
        page, _ = new_page(960, 330, "What the stop-gradient of Eq. 7 blocks")
        panels = [new_panel(page, left, left + 240, 90, 270) for left in (64, 378, 692)]
        for row, curve in curves.items():
            steps, color, label = curve["iteration"], COLORS[row], LABELS[row]
            panels[0].plot(steps, curve["direct"], color=color, label=label)
            panels[0].plot(steps, curve["blocked"], color=color, linestyle="--")
            panels[1].plot(steps, curve["cosine"], color=color)
            panels[2].plot(steps, [100 * value for value in curve["drift_median"]], color=color)
            panels[2].plot(steps, [100 * value for value in curve["drift_p90"]], color=color, linestyle=":")
        panels[0].set_ylim(bottom=0.0)
        panels[0].yaxis.set_major_formatter(lambda value, _: f"{value:g}")
        panels[0].set_title("gradient norm: direct, blocked (dashed)", loc="left")
        panels[1].axhline(0, color="#9aa0a6", linewidth=0.8)
        panels[1].set_title("cosine of direct and blocked", loc="left")
        panels[2].set_title("drift in %: median, p90 (dotted)", loc="left")
        for panel in panels:
            panel.set_xlabel("iteration")
        page.legend(*panels[0].get_legend_handles_labels(), loc="upper left", bbox_to_anchor=(0.02, 0.87), ncols=4)
        return svg(page)


def main() -> None:
    """Train and measure, or draw what was measured."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("capture", type=Path)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--preset", default="paper")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--rows", nargs="+", default=list(ROWS), choices=ROWS)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--every", type=int, default=500)
    parser.add_argument("--plot", type=Path)
    args = parser.parse_args()
    if args.plot is not None:
        args.plot.write_text(figure(args.output, args.seed))
        return
    settings = {key: json.loads(value) for key, value in (item.split("=", 1) for item in args.set)}
    ablation = Ablation(
        args.output,
        args.capture,
        preset=args.preset,
        settings=settings,
        rows=args.rows,
        seeds=(args.seed,),
        threads=args.threads,
    )
    for _, run in ablation:
        train(run, args.every)


if __name__ == "__main__":
    main()
