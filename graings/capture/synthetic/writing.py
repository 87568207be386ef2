"""synthesize: a scene of the suite as a capture on disk, with its ground truth.

transforms_{train,val,test,between}.json   cameras and times, D-NeRF layout
train/r_000.png                            8-bit images, straight alpha where the scene has no room
depth/train/r_000.exr                      depth along the optical axis in capture units, 0: nothing
moving/train/r_000.png                     share of each pixel that moving parts cover
trajectories.json                          positions of 200 surface points at all times of all splits
"""

from __future__ import annotations

import json
import multiprocessing
import shutil
import signal
import threading
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
from numpy.typing import NDArray

from graings.capture.synthetic.catalogue import scene_named
from graings.capture.synthetic.drawing import draw
from graings.capture.synthetic.planned_view import PlannedView, planned_views
from graings.capture.synthetic.tracking import track
from graings.capture.synthetic.world import World
from graings.capture.trajectories import FILE
from graings.errors import CaptureError

Observer = Callable[[int, int], None]  # images done, images in all


def synthesize(
    name: str,
    folder: Path,
    *,
    size: int = 400,
    views: int = 150,
    seed: int = 0,
    processes: int = 1,
    observe: Observer = lambda done, total: None,
) -> Path:
    """Write the scene `name` into `folder`, which is returned; `observe` is called after each image.

    Pixels, cameras and trajectories have the same bits on every machine and for every number of processes. A call that
    is interrupted or fails removes what it has written. Raises `ValueError` for an unknown name, a size or a number of
    views below 1, and `CaptureError` for a folder that is not empty.
    """
    if size < 1 or views < 1:
        raise ValueError(f"size and views must be at least 1, got {size} and {views}")
    world = scene_named(name).build(seed)
    if folder.is_dir() and any(folder.iterdir()):
        raise CaptureError("is not empty", file=folder, remedy="Name another folder.")
    splits = planned_views(world, size=size, views=views, seed=seed)
    try:
        _write_capture(world, name, folder, splits, seed, processes, observe)
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise
    return folder


def _write_capture(
    world: World,
    name: str,
    folder: Path,
    splits: dict[str, list[PlannedView]],
    seed: int,
    processes: int,
    observe: Observer,
) -> None:
    for split in splits:
        for parent in (folder, folder / "depth", folder / "moving"):
            (parent / split).mkdir(parents=True, exist_ok=True)
    every = [view for listed in splits.values() for view in listed]
    with closing(_written(name, seed, folder, every, processes)) as written:  # an interrupt waits for the processes
        for done, _ in enumerate(written, start=1):
            observe(done, len(every))
    times = sorted({view.time for view in every})
    positions = np.round(track(world, seed, times), 6) + 0.0
    (folder / FILE).write_text(json.dumps({"times": times, "positions": positions.tolist()}))
    for split, listed in splits.items():
        document = listed[0].viewpoint.intrinsics() | {"frames": [_entry(view) for view in listed]}
        (folder / f"transforms_{split}.json").write_text(json.dumps(document, indent=1))


def _entry(view: PlannedView) -> dict[str, Any]:
    return {"file_path": f"./{view.name}", "time": view.time, "transform_matrix": view.viewpoint.transform()}


def _written(
    name: str, seed: int, folder: Path, every: list[PlannedView], processes: int
) -> Generator[None, None, None]:
    if processes <= 1:
        for view in every:
            write_view(name, seed, folder, view)
            yield
        return
    # Spawned, not forked: the parent may hold threads of numerical libraries.
    with ProcessPoolExecutor(processes, multiprocessing.get_context("spawn")) as pool:
        with _interrupts_ignored():
            waiting = [pool.submit(write_view, name, seed, folder, view) for view in every]
        try:
            for future in as_completed(waiting):
                future.result()  # raises what the worker raised
                yield
        finally:
            pool.shutdown(cancel_futures=True)


@contextmanager
def _interrupts_ignored() -> Iterator[None]:
    """Processes started meanwhile ignore Ctrl-C, which a terminal sends to them too; the parent ends them."""
    if threading.current_thread() is not threading.main_thread():
        yield  # only the main thread may set handlers
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def write_view(name: str, seed: int, folder: Path, planned: PlannedView) -> None:
    """Draw one image of a scene and write it with its depth and mask."""
    world = scene_named(name).build(seed)
    view = draw(world, planned.viewpoint, planned.time)
    image = view.rgba[..., :3] if world.room else view.rgba
    _write(folder / f"{planned.name}.png", np.ascontiguousarray(image))
    _write(folder / "depth" / f"{planned.name}.exr", view.depth[..., None])
    _write(folder / "moving" / f"{planned.name}.png", view.moving[..., None])


def _write(path: Path, pixels: NDArray[np.uint8] | NDArray[np.float32]) -> None:
    height, width, channels = pixels.shape
    output = oiio.ImageOutput.create(str(path))
    spec = oiio.ImageSpec(width, height, channels, "uint8" if pixels.dtype == np.uint8 else "float")
    spec["oiio:UnassociatedAlpha"] = 1  # the colours are straight: store them as they are
    if path.suffix == ".exr":
        spec.channelnames = ("Z",)
        spec["compression"] = "zip"
        spec["DateTime"] = "2000:01:01 00:00:00"  # else the file holds the time of writing
    if output is None or not (output.open(str(path), spec) and output.write_image(pixels) and output.close()):
        raise OSError(f"cannot write {path}: {oiio.geterror() if output is None else output.geterror()}")
