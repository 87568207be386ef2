"""What leaving a part out costs in quality, and what it saves: every automatic drop of the plan, with and without.

    python benchmarks/plan_regret.py FOLDER [--size 100] [--views 60] [--iterations 400] [--only PART ...]
        [--captures CAPTURE ...]

Writes the captures it needs and the runs into FOLDER, leaves out what is finished, and prints a Markdown table: mean
PSNR of the validation views with and without the part, the 95 % interval of the paired difference (Student's t over the
seeds), CPU seconds of training, bytes of the model in float32, predicted and measured saving. The same seed is paired,
and named random streams keep the numbers of what stays. One thread, preset draft, images of at most SIZE pixels a side.
With --captures the deformation of further captures, of one time, is looked at too.
"""

from __future__ import annotations

import argparse
import shutil
import statistics
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
from runs import finished, train

from graings.capture.image_file import decode
from graings.capture.synthetic import synthesize
from graings.capture.synthetic.catalogue import scene_named
from graings.capture.synthetic.planned_view import planned_views
from graings.capture.synthetic.writing import write_view
from graings.config import make_config
from graings.plan.plan import Plan
from graings.report.metrics_document import Metrics
from graings.report.run_record import read_plan
from graings.training.calibration import calibration

# Two-sided, for 1 to 15 degrees of freedom.
T_95 = (12.706, 4.303, 3.182, 2.776, 2.571, 2.447, 2.365, 2.306, 2.262, 2.228, 2.201, 2.179, 2.160, 2.145, 2.131)
NOISE = 0.01
HEAD = (
    "| part | scene | decision | PSNR with | without | difference, 95 % | CPU s with | without | kB with | without | "
    "predicted saving | measured |"
)


@dataclass(frozen=True)
class Case:
    """A part, the capture on which its condition holds, and the options with which it is kept and left out."""

    part: str
    scene: str
    kept: dict[str, Any]
    left_out: dict[str, Any]


EAGER = {"plan.mode": "aggressive"}
CASES = (
    Case("deformation", "still", {"plan.keep": ["deformation"]}, {}),
    Case("residual", "still", {"plan.keep": ["residual"]}, {}),
    Case("deformation", "resting", {"plan.keep": ["deformation"], **EAGER}, EAGER),
    Case("residual", "resting", {"plan.keep": ["residual"], **EAGER}, EAGER),
    Case("growth", "still", {"plan.keep": ["growth"], **EAGER}, EAGER),
    Case("residual, later", "walker", {"plan.keep": ["residual"]}, {}),
    Case("view dependence of the residual", "walker", {"scene.residual_sh_degree": 2}, {"scene.residual_sh_degree": 0}),
)


def resting(folder: Path, size: int, views: int) -> Path:
    """The scene `rig` at rest: all images, held-out ones too, show its first moment, each with other noise."""
    synthesize("rig", folder, size=size, views=views)
    random = np.random.default_rng(0)
    for listed in planned_views(scene_named("rig").build(0), size=size, views=views, seed=0).values():
        for view in listed:
            write_view("rig", 0, folder, replace(view, time=0.0))
            path = folder / f"{view.name}.png"
            write_noisy(decode_copy(path), path, random)
    return folder


def decode_copy(file: Path) -> np.ndarray:
    """Pixels [H, W, 4] of a PNG under another suffix, colour multiplied by alpha."""
    image = shutil.copy(file, file.with_suffix(".copy.png"))
    try:
        return decode(Path(image), file.name)
    finally:
        Path(image).unlink()


def write_noisy(pixels: np.ndarray, path: Path, random: np.random.Generator) -> None:
    """Composite on white, add noise and write 8 bits, opaque. Contrast is lower, so that no noise is clipped."""
    rgb = pixels[..., :3] + (1 - pixels[..., 3:]) if pixels.shape[-1] == 4 else pixels
    noisy = np.clip(0.1 + 0.8 * rgb + random.normal(0, NOISE, rgb.shape), 0, 1)
    output = oiio.ImageOutput.create(str(path))
    output.open(str(path), oiio.ImageSpec(rgb.shape[1], rgb.shape[0], 3, "uint8"))
    output.write_image(np.rint(255 * noisy).astype(np.uint8))
    output.close()


def capture_of(folder: Path, scene: str, size: int, views: int, given: list[Path]) -> Path:
    """The capture: one of those given, or a synthetic one, written where it is missing."""
    for path in given:
        if path.name == scene:
            return path
    place = folder / "captures" / scene
    if not (place / "transforms_train.json").exists():
        shutil.rmtree(place, ignore_errors=True)
        make: Callable[[Path], Path] = (
            (lambda path: resting(path, size, views))
            if scene == "resting"
            else (lambda path: synthesize(scene, path, size=size, views=views))
        )
        make(place)
    return place


def trained(run: Path, capture: Path, options: dict[str, Any]) -> tuple[Metrics, Plan]:
    """Metrics and plan of a run, which is trained, or resumed, where it is not finished."""
    config = make_config("draft", options)
    train(run, capture, config)
    metrics, plan = finished(run), read_plan(run)
    assert metrics is not None
    assert plan is not None
    print(f"{run}: {metrics.train_cpu_s:.0f} CPU s", flush=True)
    return metrics, plan


def row(case: Case, pairs: list[tuple[Metrics, Metrics]], plan: Plan) -> str:
    """One line of the table; `pairs` are with and without the part, `plan` is that of a run without it."""
    psnr = [[float(m.splits["val"].psnr or 0.0) for m in pair] for pair in pairs]
    differences = [without - with_ for with_, without in psnr]
    mean = statistics.mean(differences)
    half = T_95[len(pairs) - 2] * statistics.stdev(differences) / len(pairs) ** 0.5 if len(pairs) > 1 else float("nan")
    cpu = [statistics.mean(pair[side].train_cpu_s for pair in pairs) for side in (0, 1)]
    size = [statistics.mean(pair[side].bytes.fp32 for pair in pairs) / 1e3 for side in (0, 1)]
    decision = next((d for d in plan.decisions if d.component == case.part.split(",")[0]), None)
    saving = None if decision is None else decision.saving
    predicted = "" if saving is None or saving.predicted_s is None else f"{saving.predicted_s:.0f} s"
    happened = "" if decision is None else f"{decision.kind}, {decision.decision}"
    return (
        f"| {case.part} | {case.scene} | {happened} | {statistics.mean(p[0] for p in psnr):.2f} | "
        f"{statistics.mean(p[1] for p in psnr):.2f} | {mean:+.2f} [{mean - half:+.2f}, {mean + half:+.2f}] | "
        f"{cpu[0]:.0f} | {cpu[1]:.0f} | {size[0]:.0f} | {size[1]:.0f} | {predicted} | {cpu[0] - cpu[1]:.0f} s |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--size", type=int, default=100)
    parser.add_argument("--views", type=int, default=60)
    parser.add_argument("--iterations", type=int, default=400)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--only", nargs="+", help="parts, as the table names them")
    parser.add_argument("--scenes", nargs="+", help="scenes, as the table names them")
    parser.add_argument("--captures", type=Path, nargs="+", default=[])
    options = parser.parse_args()
    if len(options.seeds) > len(T_95) + 1:
        parser.error(f"at most {len(T_95) + 1} seeds")
    calibration(1)
    lines = []
    added = [Case("deformation", path.name, {"plan.keep": ["deformation"]}, {}) for path in options.captures]
    for case in (*CASES, *added):
        if case.part not in (options.only or [case.part]) or case.scene not in (options.scenes or [case.scene]):
            continue
        capture = capture_of(options.folder, case.scene, options.size, options.views, options.captures)
        pairs, plan = [], None
        for seed in options.seeds:
            pair = []
            for side in (case.kept, case.left_out):
                # The same options give the same run, which several cases share.
                key = "-".join(f"{k}={v}" for k, v in sorted(side.items())) or "default"
                run = options.folder / "runs" / case.scene / "".join(c if c.isalnum() else "_" for c in key) / str(seed)
                common = {"iterations": options.iterations, "threads": 1, "seed": seed, "time_window": 1.0}
                common["capture.max_side"] = options.size
                metrics, plan = trained(run, capture, {**common, **side})
                pair.append(metrics)
            pairs.append((pair[0], pair[1]))
        assert plan is not None
        lines.append(row(case, pairs, plan))
        print(lines[-1], flush=True)
    print(HEAD)
    print("|---|---|---|---|---|---|---|---|---|---|---|---|")
    print("\n".join(lines))


if __name__ == "__main__":
    main()
