"""Test views of a preset beside published numbers, in the protocols of the field.

    python benchmarks/field_tables.py FOLDER CAPTURE... --preset paper [--protocol white-800] [--seed 0] [--threads 1]

Trains each capture at the size and on the background of the protocol in FOLDER/PRESET/PROTOCOL/CAPTURE; a finished run
is not repeated, an interrupted one is resumed. Then the test split is evaluated, once. Prints a Markdown table, written
to FOLDER/PRESET/PROTOCOL/table.md after each capture: metrics of the test views, the worst of them, PSNR of the
validation views, CPU minutes, size, and the published PSNR of the scene of that name.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from runs import finished, train

from graings.config import make_config
from graings.report.evaluate_run import evaluate_run
from graings.report.metrics_document import Metrics


@dataclass(frozen=True)
class Protocol:
    """Size and background, and the PSNR of the method with the best published mean: of test views, by scene."""

    max_side: int
    background: str
    method: str
    published: dict[str, float]


SCENES: Final = ("hook", "jumpingjacks", "trex", "bouncingballs", "hellwarrior", "mutant", "standup")


def by_scene(*psnr: float) -> dict[str, float]:
    return dict(zip(SCENES, psnr, strict=True))


PROTOCOLS: Final = {
    "white-400": Protocol(400, "white", "none publishes it", {}),
    "white-800": Protocol(800, "white", "GrainGS", by_scene(36.89, 38.51, 38.86, 43.49, 32.93, 39.45, 40.34)),
    "black-400": Protocol(400, "black", "SC-GS", by_scene(39.87, 41.13, 41.24, 44.91, 42.93, 45.19, 47.89)),
    "black-800": Protocol(800, "black", "Grid4D + SC", by_scene(40.26, 39.58, 41.12, 42.17, 42.81, 44.07, 46.87)),
}


def table(folder: Path, captures: list[Path], protocol: Protocol) -> Iterator[str]:
    """The table as Markdown; captures that are not evaluated yet are left out."""
    heads = ("scene", "PSNR", "SSIM", "LPIPS", "worst view", "validation", "CPU minutes", "Gaussians", "anchors", "MB")
    yield "| " + " | ".join((*heads, protocol.method)) + " |"
    yield "|---" * (len(heads) + 1) + "|"
    means: list[float] = []
    for capture in captures:
        metrics = finished(folder / capture.name)
        if metrics is None or "test" not in metrics.splits:
            continue
        yield row(capture.name, metrics, protocol)
        psnr = metrics.splits["test"].psnr
        if psnr is not None:
            means.append(psnr)
    if means:
        yield f"| mean of {len(means)} | {sum(means) / len(means):.2f} |" + " |" * (len(heads) - 1)


def number(value: float | None, digits: int) -> str:
    return "null" if value is None else f"{value:.{digits}f}"


def row(name: str, metrics: Metrics, protocol: Protocol) -> str:
    test, val = metrics.splits["test"], metrics.splits["val"]
    published = protocol.published.get(name)
    cells = (
        name,
        number(test.psnr, 2),
        number(test.ssim_3dgs, 4),
        number(test.lpips_vgg, 4),
        number(min((view.psnr for view in test.views), default=None), 1),
        number(val.psnr, 2),
        f"{metrics.train_cpu_s / 60:.0f}",
        f"{metrics.gaussians}",
        f"{metrics.anchors}",
        f"{metrics.bytes.fp32 / 1e6:.2f}",
        "" if published is None else f"{published:.2f}",
    )
    return "| " + " | ".join(cells) + " |"


def main() -> None:
    """Train and evaluate the captures one after the other."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("captures", type=Path, nargs="+")
    parser.add_argument("--preset", default="paper")
    parser.add_argument("--protocol", default="white-800", choices=PROTOCOLS)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, default=1)
    args = parser.parse_args()
    protocol = PROTOCOLS[args.protocol]
    options = {"capture.max_side": protocol.max_side, "capture.background": protocol.background}
    config = make_config(args.preset, {**options, "seed": args.seed, "threads": args.threads})
    folder = args.folder / args.preset / args.protocol
    for capture in args.captures:
        train(folder / capture.name, capture, config)
        metrics = finished(folder / capture.name)
        if metrics is not None and "test" not in metrics.splits:
            evaluate_run(folder / capture.name, "test")
        (folder / "table.md").write_text("\n".join(table(folder, args.captures, protocol)) + "\n")
    print("\n".join(table(folder, args.captures, protocol)))


if __name__ == "__main__":
    main()
