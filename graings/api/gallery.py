"""write_gallery: a page of trained models: a clip of each, its numbers, and a link to the player of its scene."""

from __future__ import annotations

import html
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final
from urllib.parse import quote

from graings.api.scenes import export_model, open_scene, render_video, render_view, save_image
from graings.capture.synthetic import SUITE
from graings.errors import CheckpointError
from graings.report.metrics_document import Metrics, read_metrics
from graings.report.run_record import read_record
from graings.report.work_precision import named_folder
from graings.storage.run_folder import METRICS_FILE, newest_model

SIDE: Final = 320  # px of stills and clips
SECONDS: Final = 4.0
FPS: Final = 20.0
PAGE_FILE: Final = "index.html"

_PAGE: Final = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; img-src 'self'; style-src 'unsafe-inline'">
<title>{title}</title>
<style>
:root {{ color-scheme: light dark; font: 15px/1.45 system-ui, sans-serif; --soft: #77716a; }}
@media (prefers-color-scheme: dark) {{ :root {{ --soft: #9d968c; }} }}
body {{ margin: 0 auto; max-width: 76rem; padding: 1.5rem; }}
h1 {{ font-size: 1.3rem; }}
ul {{ list-style: none; margin: 0; padding: 0; display: grid; gap: 1.5rem;
      grid-template-columns: repeat(auto-fill, minmax(min(100%, 17rem), 1fr)); }}
img {{ width: 100%; height: auto; border-radius: .6rem; display: block; }}
h2 {{ font-size: 1rem; margin: .6rem 0 .1rem; }}
p {{ margin: 0; color: var(--soft); font-size: .87rem; }}
a {{ color: inherit; }}
</style>
</head>
<body>
<h1>{title}</h1>
<ul>
{items}</ul>
</body>
</html>
"""
_ITEM: Final = """<li>
<a href="{link}.html"><picture>
<source srcset="{link}.png" media="(prefers-reduced-motion: reduce)">
<img src="{link}.webp" width="{side}" height="{side}" loading="lazy" alt="{name}, turned once while time runs">
</picture></a>
<h2><a href="{link}.html">{name}</a></h2>
<p>{about}</p>
<p>{numbers}</p>
</li>
"""


def write_gallery(
    runs: Sequence[Path],
    folder: Path,
    *,
    title: str = "Moving scenes",
    observe: Callable[[int, int], None] = lambda done, total: None,
) -> Path:
    """Write the page and its files into `folder` and return the page; `observe` gets frames done and frames in all.

    Clips are WebP and need the extra [video]; each run is named after its folder. What is already there is replaced.
    Raises `ValueError` for two runs of one name and for one whose page would be that of the gallery, and
    `CheckpointError` for a folder that holds no finished run. All runs are looked at before anything is rendered.
    """
    names = [named_folder(run.resolve()).name for run in runs]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise ValueError(f"runs are named after their folders, and several are {', '.join(twice)}; rename one")
    if Path(PAGE_FILE).stem in names:
        raise ValueError(f"runs are named after their folders, and {PAGE_FILE} is the gallery's page; rename that run")
    finished = [_finished(run) for run in runs]
    folder.mkdir(parents=True, exist_ok=True)
    per_clip, items = round(SECONDS * FPS), []
    for index, (run, name, (metrics, capture)) in enumerate(zip(runs, names, finished, strict=True)):
        counted = partial(_count, observe, index * per_clip, len(runs) * per_clip)
        items.append(_item(run, name, metrics, capture, folder, counted))
    page = folder / PAGE_FILE
    page.write_text(_PAGE.format(title=html.escape(title), items="".join(items)), encoding="utf-8")
    return page


def _finished(run: Path) -> tuple[Metrics, str]:
    """The metrics of a run that has ended and has a model, and the name of its capture. Raises `CheckpointError`."""
    metrics = read_metrics(run / METRICS_FILE)
    if metrics.iterations < metrics.iterations_planned:
        raise CheckpointError(f"{run}: is not finished. Continue it (graings train --resume -o {run}).")
    if newest_model(run) is None:
        raise CheckpointError(f"{run}: has no model. Leave it out, or train it again.")
    return metrics, read_record(run).capture.path.name


def _count(observe: Callable[[int, int], None], before: int, total: int, done: int) -> None:
    observe(before + done, total)


def _item(run: Path, name: str, metrics: Metrics, capture: str, folder: Path, observe: Callable[[int], None]) -> str:
    scene = open_scene(run)
    view: dict[str, Any] = {"width": SIDE, "height": SIDE}
    save_image(folder / f"{name}.png", render_view(scene, t=0.5, **view))
    clip = folder / f"{name}.webp"
    render_video(scene, clip, seconds=SECONDS, fps=FPS, observe=observe, **view)
    export_model(run, folder / f"{name}.html")
    questions = {entry.name: entry.question for entry in SUITE}
    about = questions.get(capture, f"{metrics.gaussians:,} Gaussians")
    # The PSNR of a split without images is None.
    measured = [(split, metrics.splits[split].psnr) for split in ("val", "test") if split in metrics.splits]
    found = [f"{split} {psnr:.2f} dB" for split, psnr in measured if psnr is not None]
    size = (folder / f"{name}.html").stat().st_size
    numbers = [*found, f"{metrics.train_cpu_s / 60:.0f} min of CPU time", f"player with scene {size / 1e6:.1f} MB"]
    return _ITEM.format(
        name=html.escape(name),
        link=quote(name),
        side=SIDE,
        about=html.escape(about),
        numbers=html.escape(" · ".join(numbers)),
    )
