"""The synthetic suite: seconds to generate it, and how well it is reconstructed.

    python benchmarks/synthetic_suite.py FOLDER                          generate all scenes, print seconds and MB
    python benchmarks/synthetic_suite.py FOLDER --train draft standard   train each on top, print the table of results
    python benchmarks/synthetic_suite.py FOLDER --sheet SHEET.png        draw the contact sheet
    python benchmarks/synthetic_suite.py FOLDER --train draft --gallery GALLERY.png    and views of the trained models

Captures lie in FOLDER/SIZE/NAME, runs in FOLDER/SIZE/runs/NAME-PRESET. What is finished is not repeated; an interrupted
training is resumed. Seconds are CPU seconds of all processes (user + sys) and the same divided by two: the time on two
idle cores. The tables are Markdown.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
from runs import check, finished

from graings.camera.viewpoint import sized
from graings.capture.synthetic import SUITE
from graings.capture.synthetic.drawing import draw
from graings.capture.synthetic.viewpoint import on_path
from graings.cli.training import setting
from graings.config import make_config
from graings.image_encoding import encode_image
from graings.render import render
from graings.storage.checkpoint import load_model
from graings.storage.run_folder import RECORD_FILE

TIMES = (0.1, 0.45, 0.8)
GALLERY_TIMES = (0.05, 0.25, 0.45, 0.65, 0.85)
TILE = 120
CAPTION = 16
# Which camera of the path shows a scene well on the contact sheet.
SHOWN_FROM = {"flag": 1, "room": 1, "ring": 1, "crossing": 1, "chrome": 1, "sundial": 3}


def cpu_seconds() -> float:
    """CPU seconds of the children that have ended."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def generate(folder: Path, names: Sequence[str], size: int, views: int) -> dict[str, dict[str, float]]:
    """Seconds, images and MB of each scene; those written earlier keep their numbers."""
    record = folder / "generation.json"
    numbers: dict[str, dict[str, float]] = json.loads(record.read_text()) if record.is_file() else {}
    for name in names:
        target = folder / name
        if name in numbers and (target / "transforms_train.json").is_file():
            if numbers[name].get("views", views) != views:
                raise SystemExit(f"{target}: has {numbers[name]['views']:.0f} views. Give another folder for {views}.")
            continue
        shutil.rmtree(target, ignore_errors=True)
        before, started = cpu_seconds(), time.perf_counter()
        graings("synthesize", name, "-o", target, "--size", size, "--views", views)
        cpu, wall = cpu_seconds() - before, time.perf_counter() - started
        files = [file for file in target.rglob("*") if file.is_file()]
        images = [file for file in files if file.suffix == ".png" and "moving" not in file.parts]
        numbers[name] = {
            "views": views,
            "images": len(images),
            "cpu_s": cpu,
            "wall_s": wall,
            "images_mb": sum(file.stat().st_size for file in images) / 1e6,
            "total_mb": sum(file.stat().st_size for file in files) / 1e6,
        }
        record.write_text(json.dumps(numbers, indent=1))
        print(f"{name}: {cpu:.0f} CPU seconds", file=sys.stderr, flush=True)
    return numbers


def train(folder: Path, name: str, preset: str, extra: Sequence[str]) -> dict[str, Any]:
    """The metrics document of the finished and evaluated run."""
    run = folder / "runs" / f"{name}-{preset}"
    metrics = run / "metrics.json"
    if (run / RECORD_FILE).is_file():
        options = dict(setting(part) for part in extra if part != "--set")
        check(run, folder / name, make_config(preset, options))
    splits = ("test",) if name == "still" else ("test", "between")
    if finished(run) is None:
        if any(run.glob("checkpoints/*")) or any(run.glob("*.safetensors")):
            graings("train", "--resume", "-o", run)
        else:
            shutil.rmtree(run, ignore_errors=True)
            graings("train", folder / name, "-o", run, "--preset", preset, *extra)
    for split in splits:
        if split not in json.loads(metrics.read_text())["splits"]:
            graings("evaluate", run, "--split", split)
    document: dict[str, Any] = json.loads(metrics.read_text())
    return document


def graings(*arguments: object) -> None:
    """Run the command line in a process of its own."""
    subprocess.run(
        [sys.executable, "-m", "graings", *map(str, arguments)],
        check=True,
        stdout=sys.stderr,
        env={**os.environ, "COLUMNS": "120"},
    )


def generation_table(numbers: dict[str, dict[str, float]], names: Sequence[str]) -> list[str]:
    """One row per scene."""
    rows = [
        "| scene | images | CPU s | s on two cores | MB of images | MB with ground truth |",
        "|---|---|---|---|---|---|",
    ]
    for name in names:
        row = numbers[name]
        rows.append(
            f"| {name} | {row['images']:.0f} | {row['cpu_s']:.0f} | {row['cpu_s'] / 2:.0f} | "
            f"{row['images_mb']:.1f} | {row['total_mb']:.1f} |"
        )
    return rows


def result_row(name: str, preset: str, document: dict[str, Any]) -> str:
    """PSNR and SSIM on both splits, motion error in percent of the extent, CPU minutes of training and MB."""
    cells = [name, preset]
    for split in ("test", "between"):
        means = document["splits"].get(split)
        cells += ["", ""] if means is None else [f"{means['psnr']:.2f}", f"{means['ssim_3dgs']:.4f}"]
    motion = document.get("motion")
    cells += ["", "", ""]
    if motion is not None:
        cells[-3:] = [f"{100 * motion[key]:.2f}" for key in ("mean", "percentile_90", "mean_at_rest")]
    compact = document.get("compact") or {}
    size = compact.get("bytes", document["bytes"]["fp32"])
    cells += [f"{document['train_cpu_s'] / 60:.1f}", f"{size / 1e6:.2f}"]
    return f"| {' | '.join(cells)} |"


RESULT_HEAD = (
    "| scene | preset | PSNR test | SSIM test | PSNR between | SSIM between | motion error % | 90th percentile % | "
    "if nothing moved % | CPU minutes | MB |",
    "|---|---|---|---|---|---|---|---|---|---|---|",
)


def sheet(file: Path, names: Sequence[str], tile: int) -> None:
    """All scenes at three times each, seen by one camera, two scenes in a row."""
    strips = [strip(name, tile) for name in names]
    half = (len(strips) + 1) // 2
    if len(strips) % 2:
        strips.append(np.full_like(strips[0], 255))
    gap = np.full((strips[0].shape[0], tile // 8, 3), 255, dtype=np.uint8)
    rows = [np.concatenate([strips[i], gap, strips[half + i]], axis=1) for i in range(half)]
    pixels = np.ascontiguousarray(np.concatenate(rows))
    output = oiio.ImageOutput.create(str(file))
    spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], 3, "uint8")
    spec["png:compressionLevel"] = 9
    output.open(str(file), spec)
    output.write_image(pixels)
    output.close()


def strip(name: str, tile: int) -> np.ndarray:
    """A scene at three times under its name, [H, W, 3]."""
    world = next(scene for scene in SUITE if scene.name == name).build(0)
    viewpoint = on_path(world.path, SHOWN_FROM.get(name, 0), 0.1, tile)
    views = []
    for moment in TIMES:
        rgba = draw(world, viewpoint, moment).rgba / 255.0
        views.append(rgba[..., :3] * rgba[..., 3:] + 1.0 - rgba[..., 3:])
    caption = oiio.ImageBuf(oiio.ImageSpec(3 * tile, CAPTION, 3, "uint8"))
    oiio.ImageBufAlgo.fill(caption, (1.0, 1.0, 1.0))
    oiio.ImageBufAlgo.render_text(caption, 4, CAPTION - 4, name, CAPTION - 3, "", (0.15, 0.15, 0.15))
    drawn = np.rint(255.0 * np.concatenate(views, axis=1)).astype(np.uint8)
    return np.concatenate([caption.get_pixels(oiio.UINT8), drawn])


def gallery(file: Path, folder: Path, names: Sequence[str], preset: str) -> None:
    """Trained models at five times each, seen by a camera of their test split; one scene a row, at half size."""
    rows = []
    for name in names:
        model = load_model(folder / "runs" / f"{name}-{preset}")
        view = model.views["test"][len(model.views["test"]) // 3]
        camera = sized(view.camera, view.camera.width // 2)
        images = [render(model.scene, camera, time, model.background).color for time in GALLERY_TIMES]
        rows.append(np.concatenate([np.clip(image.numpy(), 0.0, 1.0) for image in images], axis=1))
    file.write_bytes(encode_image(np.concatenate(rows)))


def main() -> None:
    """Generate, and draw or train as the arguments say."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--scenes", nargs="+", default=[scene.name for scene in SUITE])
    parser.add_argument("--size", type=int, default=400)
    parser.add_argument("--views", type=int, default=150)
    parser.add_argument("--train", nargs="+", metavar="PRESET", default=[])
    parser.add_argument("--set", nargs="+", action="extend", metavar="OPTION=VALUE", default=[], help="for training")
    parser.add_argument("--sheet", type=Path)
    parser.add_argument("--gallery", type=Path, help="of the first preset of --train")
    arguments = parser.parse_args()
    if arguments.sheet is not None:
        sheet(arguments.sheet, arguments.scenes, TILE)
        return
    folder = arguments.folder / str(arguments.size)
    folder.mkdir(parents=True, exist_ok=True)
    numbers = generate(folder, arguments.scenes, arguments.size, arguments.views)
    print("\n".join(generation_table(numbers, arguments.scenes)))
    if arguments.train:
        extra = [part for setting in arguments.set for part in ("--set", setting)]
        print("\n" + "\n".join(RESULT_HEAD), flush=True)
        for name in arguments.scenes:
            for preset in arguments.train:
                print(result_row(name, preset, train(folder, name, preset, extra)), flush=True)
        if arguments.gallery is not None:
            gallery(arguments.gallery, folder, arguments.scenes, arguments.train[0])


if __name__ == "__main__":
    main()
