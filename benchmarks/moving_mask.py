"""PSNR and SSIM of runs on what moves: inside the masks `moving/NAME.png` of their capture, beside the whole images.

    python benchmarks/moving_mask.py RUN... [--split test] [--polygons FILE] [--threads 1]

The captures of `graings synthesize` have exact masks, white where something moves. For another capture give polygons
that are drawn by hand: `benchmarks/moving/train.json` has those of the clip `train`. Views in which nothing moves, or
for which there are no polygons, are left out. The table is Markdown.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from graings.capture.capture import Frame
from graings.capture.images import ImageStore
from graings.capture.load import load_capture
from graings.capture.mask import Mask, read_mask
from graings.evaluation.metrics import Pair, SplitMetrics, measure_split
from graings.kernel import use_threads
from graings.render import render
from graings.report.run_record import read_record
from graings.scene.prepared import PreparedScene
from graings.storage.compact import open_model

Polygons = dict[str, list[tuple[float, float]]]


def exact_mask(root: Path, frame: Frame) -> Mask:
    """What moves in `frame` [H, W], from the capture's own mask."""
    path = (root / "moving" / frame.name).with_suffix(".png")
    return read_mask(path, str(path), (frame.camera.width, frame.camera.height))


def drawn_mask(polygons: Polygons, frame: Frame) -> Mask:
    """Pixels [H, W] with their centre inside the polygon of `frame` (even-odd rule); none without a polygon."""
    camera, corners = frame.camera, np.array(polygons.get(frame.name, ()), dtype=np.float64).reshape(-1, 2)
    x = (np.arange(camera.width) + 0.5) / camera.width
    y = ((np.arange(camera.height) + 0.5) / camera.height)[:, None]
    inside = np.zeros((camera.height, camera.width), np.bool_)
    for (x0, y0), (x1, y1) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        if y0 != y1:
            inside ^= ((y0 <= y) != (y1 <= y)) & (x < x0 + (y - y0) / (y1 - y0) * (x1 - x0))
    return inside


def measured(run: Path, split: str, polygons: Polygons) -> tuple[SplitMetrics, SplitMetrics]:
    """Metrics of the views of a split that show something that moves: whole, and inside the masks."""
    record, model = read_record(run), open_model(run)
    capture = load_capture(Path(record.capture.path), record.config.capture)
    images, scene = ImageStore(model.background, record.config.capture.cache_mb), PreparedScene(model.scene)

    def pairs(inside: bool) -> Iterator[Pair]:
        for frame in capture.split(split):
            mask = drawn_mask(polygons, frame) if polygons else exact_mask(capture.root, frame)
            if not mask.any():
                continue
            drawn = render(scene, frame.camera, frame.time, model.background).color.clamp(0, 1).numpy()
            yield Pair(frame.name, frame.time, drawn, images.rgb(frame), mask if inside else None)

    return measure_split(pairs(False)), measure_split(pairs(True))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, nargs="+")
    parser.add_argument("--split", choices=("val", "test", "between"), default="test")
    parser.add_argument("--polygons", type=Path, help="JSON: corners by frame, as fractions of width and height")
    parser.add_argument("--threads", type=int, default=1)
    args = parser.parse_args()
    use_threads(args.threads)
    polygons = json.loads(args.polygons.read_text(encoding="utf-8"))["frames"] if args.polygons else {}
    print("| run | views | PSNR, SSIM | on what moves |\n|---|---|---|---|")
    for run in args.runs:
        whole, inside = measured(run, args.split, polygons)
        if whole.psnr is None or inside.psnr is None or whole.ssim_3dgs is None or inside.ssim_3dgs is None:
            print(f"| {run.name} | 0 | no view of {args.split} shows what moves | |")
            continue
        print(
            f"| {run.name} | {len(whole.views)} | {whole.psnr:.2f}, {whole.ssim_3dgs:.4f} "
            f"| {inside.psnr:.2f}, {inside.ssim_3dgs:.4f} |"
        )


if __name__ == "__main__":
    main()
