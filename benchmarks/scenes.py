"""The scenes the rasterizer is timed on: generated ones, a public splat file, a trained model.

A scene is what a yardstick and ours both take: arrays of float32 by name (`means`, `quats` wxyz, `scales`,
`opacities`, `colors`), and a view (`viewmat`, `fx`, `fy`, `cx`, `cy`, `W`, `H`). Knows nothing of rasterizers.
"""

from __future__ import annotations

import importlib
import math
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from graings.storage.checkpoint import load_model

Array = NDArray[np.float32]
_SH_CONSTANT = 0.28209479177387814  # of degree 0


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """Gaussians, a view of them, and a picture to differ from."""

    name: str
    arrays: dict[str, Array]
    view: dict[str, Any]
    target: Array


def module_of(folder: Path, name: str) -> ModuleType | None:
    """A module in the yardstick's folder, or None where it has none."""
    if not (folder / f"{name}.py").is_file():
        return None
    if str(folder) not in sys.path:
        sys.path.insert(0, str(folder))
    return importlib.import_module(name)


def named(name: str, folder: Path) -> Scene:
    """The scene that `names` calls so."""
    source, size = name.rsplit("/", 1)
    generator = module_of(folder, "bench_scene")
    if generator is None:
        raise FileNotFoundError(f"{folder / 'bench_scene.py'} not found: give its folder with --yardstick")
    target = generator.target_image(int(size), int(size))
    if source.isdigit():
        return Scene(name, generator.make_scene(int(source)), generator.camera(int(size)), target)
    path = Path(source)
    arrays, view = _trained(path, int(size)) if path.is_dir() else (splat(path), None)
    if view is None:
        view = generator.camera(int(size), dist=_fitting(arrays))
    return Scene(name, arrays, view, target)


def names(gaussians: list[int], sizes: list[int], splats: list[Path], runs: list[Path]) -> Iterator[str]:
    """One name per scene: where it comes from, a slash, and the edge of its picture in pixels."""
    for source in (*gaussians, *splats, *runs):
        for size in sizes:
            yield f"{source}/{size}"


def splat(path: Path) -> dict[str, Array]:
    """The Gaussians of a binary splat file (PLY as 3DGS writes it), centred, with their colour of degree 0."""
    header, _, body = path.read_bytes().partition(b"end_header\n")
    lines = header.decode("ascii").splitlines()
    if "format binary_little_endian 1.0" not in lines or any(line.startswith("property list") for line in lines):
        raise ValueError(f"{path}: not a binary little-endian splat file")
    fields = [line.split()[2] for line in lines if line.startswith("property float ")]
    count = next(int(line.split()[2]) for line in lines if line.startswith("element vertex"))
    table = np.frombuffer(body, np.float32, count * len(fields)).reshape(count, len(fields))

    def columns(*wanted: str) -> Array:
        return np.ascontiguousarray(table[:, [fields.index(name) for name in wanted]])

    means = columns("x", "y", "z")
    quats = columns("rot_0", "rot_1", "rot_2", "rot_3")
    return {
        "means": means - np.median(means, axis=0),
        "quats": quats / np.linalg.norm(quats, axis=1, keepdims=True),
        "scales": np.exp(columns("scale_0", "scale_1", "scale_2")),
        "opacities": 1 / (1 + np.exp(-columns("opacity")[:, 0])),
        "colors": np.clip(0.5 + _SH_CONSTANT * columns("f_dc_0", "f_dc_1", "f_dc_2"), 0, 1),
    }


def _fitting(arrays: dict[str, Array]) -> float:
    """A distance from which a camera of 50 degrees sees most of the Gaussians."""
    radius = float(np.quantile(np.linalg.norm(arrays["means"], axis=1), 0.95))
    return radius / math.sin(math.radians(25))


def _trained(run: Path, size: int) -> tuple[dict[str, Array], dict[str, Any]]:
    """What a trained model draws for its first validation view, and that view."""
    model = load_model(run)
    view = model.views["val"][0]
    camera = view.camera.resized(size, size)
    with torch.inference_mode():
        gaussians = model.scene.gaussians(camera.center, view.time)
    arrays = {name: getattr(gaussians, name).numpy().copy() for name in ("means", "quats", "opacities", "colors")}
    arrays["scales"] = gaussians.log_scales.exp().numpy()
    pose = {"viewmat": np.array(camera.world_to_camera, np.float32)}
    return arrays, pose | {"fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy, "W": size, "H": size}
