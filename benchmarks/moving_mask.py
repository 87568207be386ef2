"""PSNR and SSIM of runs on what moves: inside the masks `moving/NAME.png` of their capture, beside the whole images.

    python benchmarks/moving_mask.py RUN... [--split test] [--threads 1]

The captures of `graings synthesize` have exact masks. For another capture draw them by hand: white where something
moves. A pixel counts where the mask is brighter than half of its brightest; views without such a pixel are left out.
The table is Markdown.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

from graings.capture.images import ImageStore
from graings.capture.load import load_capture
from graings.capture.mask import read_mask
from graings.evaluation.metrics import Pair, SplitMetrics, measure_split
from graings.kernel import use_threads
from graings.render import render
from graings.report.run_record import read_record
from graings.scene.prepared import PreparedScene
from graings.storage.compact import open_model


def measured(run: Path, split: str) -> tuple[SplitMetrics, SplitMetrics]:
    """Metrics of the views of a split that show something that moves: whole, and inside the masks."""
    record, model = read_record(run), open_model(run)
    capture = load_capture(Path(record.capture.path), record.config.capture)
    images, scene = ImageStore(model.background, record.config.capture.cache_mb), PreparedScene(model.scene)

    def pairs(inside: bool) -> Iterator[Pair]:
        for frame in capture.split(split):
            path = (capture.root / "moving" / frame.name).with_suffix(".png")
            mask = read_mask(path, str(path), frame.source_size)
            if mask.shape != (frame.camera.height, frame.camera.width):
                raise SystemExit(f"{path}: the run was trained at another size; masks are not resized.")
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
    parser.add_argument("--threads", type=int, default=1)
    args = parser.parse_args()
    use_threads(args.threads)
    print("| run | views | PSNR, SSIM | on what moves |\n|---|---|---|---|")
    for run in args.runs:
        whole, inside = measured(run, args.split)
        print(
            f"| {run.name} | {len(whole.views)} | {whole.psnr:.2f}, {whole.ssim_3dgs:.4f} "
            f"| {inside.psnr:.2f}, {inside.ssim_3dgs:.4f} |"
        )


if __name__ == "__main__":
    main()
