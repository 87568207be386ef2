"""Models: PLY files of points and of splats, checkpoints (safetensors and JSON) and .graings files."""

from __future__ import annotations

import gzip
import json
import tempfile
from functools import cache
from pathlib import Path
from random import Random

import numpy as np
import torch

from fuzzing.mutations import NUMBERS, WIDE, mutated, mutated_json
from graings.camera.camera import Camera, View
from graings.camera.sampling_rate import SamplingRate
from graings.camera.units import Units
from graings.capture.readers.ply import read_ply
from graings.config import SceneConfig, make_config
from graings.export.formats import read_splats
from graings.export.harmonics_fit import fit_splats
from graings.export.ply import ply_bytes
from graings.render import PreparedScene, render
from graings.scene.scaffold import Scaffold
from graings.scene.scene import Scene
from graings.storage.checkpoint import TrainingState, load_state, load_training, save_checkpoint
from graings.storage.compact import read_compact, write_compact
from graings.storage.model import Model

FILES = ("scene.safetensors", "state.safetensors", "checkpoint.json")
WHITE = (1.0, 1.0, 1.0)


@cache
def model() -> Model:
    torch.manual_seed(0)
    config = SceneConfig.model_validate(
        {"children": 3, "feature_dim": 8, "head_width": 8, "static_width": 8, "deform_width": 16, "deform_depth": 2}
    )
    scaffold = Scaffold(
        anchors=torch.randn(12, 3) * 0.3,
        log_scales=torch.full((12, 3), -2.5),
        features=torch.randn(12, 8),
        offsets=torch.randn(12, 3, 3) * 0.3,
    )
    rate = SamplingRate(extent=1.0, reference=10.0, coarsest=10.0)
    scene = Scene(config, scaffold, extent=1.0, sampling=rate, initial_opacity=0.3)
    scene.temporal = True
    views = [View(f"v{i}", Camera.orbit(60.0 * i, 20.0, 2.5, fov=0.9, width=16, height=16), i / 5) for i in range(6)]
    parts = {"train": tuple(views[1:]), "val": (views[0],)}
    units = Units((0.0, 0.0, 0.0), 0.5, time_span=2.0)
    return Model(scene, units, WHITE, parts, make_config(), 7, True, "0" * 64, Path("seed"))


@cache
def compact_seed() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        write_compact(model(), Path(folder) / "seed.graings")
        return (Path(folder) / "seed.graings").read_bytes()


@cache
def _zeros() -> bytes:
    return gzip.compress(bytes(64 << 20), compresslevel=9)


@cache
def checkpoint_seeds() -> dict[str, bytes]:
    one = model()
    state = TrainingState({"moment": torch.randn(4, 3), "step": torch.tensor(7)}, {"rates": [0.1, 0.2], "skipped": 0})
    with tempfile.TemporaryDirectory() as folder:
        saved = save_checkpoint(
            Path(folder),
            scene=one.scene,
            state=state,
            units=one.units,
            background=WHITE,
            views=one.views,
            config=one.config,
            iteration=7,
            finished=True,
        )
        return {name: (saved / name).read_bytes() for name in FILES}


def mutated_header(data: bytes, rng: Random) -> bytes:
    """Safetensors with a changed header: shapes, types, offsets, metadata; its length is right, mostly."""
    size = int.from_bytes(data[:8], "little")
    header, body = data[8 : 8 + size], data[8 + size :]
    if rng.random() < 0.3 and b'"graings"' in header:
        document = json.loads(header)
        facts = json.loads(document["__metadata__"]["graings"])
        document["__metadata__"]["graings"] = mutated_json(facts, rng).decode("utf-8", "replace")
        header = json.dumps(document).encode()
    else:
        header = mutated_json(json.loads(header), rng)
    length = rng.choice(WIDE) % (1 << 64) if rng.random() < 0.05 else len(header)
    return length.to_bytes(8, "little") + header + body


def poisoned(data: bytes, rng: Random) -> bytes:
    """Numbers of tensors replaced by such as are not finite or far too large, so that reading succeeds."""
    start = 8 + int.from_bytes(data[:8], "little")
    changed = bytearray(data)
    for _ in range(rng.choice((1, 10, 1_000))):
        place = start + 4 * rng.randrange((len(data) - start) // 4)
        value = np.float32(rng.choice((np.nan, np.inf, -np.inf, 1e38, -1e38, 1e-40, 1e20, 88.0)))
        changed[place : place + 4] = value.tobytes()
    return bytes(changed)


def make_compact(rng: Random) -> tuple[str, bytes]:
    packed = compact_seed()
    data = gzip.decompress(packed)
    kind = rng.random()
    if kind < 0.15:
        return "model.graings", mutated(packed, rng, [packed])
    if kind < 0.6:
        data = mutated_header(data, rng)
    elif kind < 0.8:
        data = mutated(data, rng, [packed, data])
    elif kind < 0.98:
        data = poisoned(data, rng)
    else:
        return "model.graings", packed + _zeros() * rng.choice((1, 20, 100))  # a gzip file may have several members
    return "model.graings", gzip.compress(data, compresslevel=1)


def make_safetensors(rng: Random) -> tuple[str, bytes]:
    name = rng.choice(FILES)
    data = checkpoint_seeds()[name]
    if name.endswith("json"):
        return name, mutated_json(json.loads(data), rng) if rng.random() < 0.7 else mutated(data, rng, [data])
    if rng.random() < 0.6:
        return name, mutated_header(data, rng)
    return name, mutated(data, rng, [data])


def open_checkpoint(folder: Path) -> Path:
    (folder / "00000007").mkdir()
    for name, data in checkpoint_seeds().items():
        (folder / "00000007" / name).write_bytes(data)
    return folder / "00000007"


def read_checkpoint(folder: Path, name: str, data: bytes) -> None:
    (folder / name).write_bytes(data)
    try:
        load_training(folder)
        load_state(folder)
    finally:
        (folder / name).write_bytes(checkpoint_seeds()[name])


def read_model(folder: Path, name: str, data: bytes) -> None:
    """Read the file and draw a view of it, as whoever received it would."""
    (folder / name).write_bytes(data)
    found = read_compact(folder / name)
    camera = Camera.orbit(30.0, 20.0, 2.5, fov=0.9, width=16, height=16)
    render(PreparedScene(found.scene), camera, 0.4, WHITE)


@cache
def ply_seeds() -> tuple[tuple[str, bytes], ...]:
    rng = np.random.default_rng(0)
    points = rng.normal(size=(8, 3))
    head = b"ply\nformat %s 1.0\ncomment x\nelement vertex 8\nproperty float x\nproperty float y\nproperty float z\n"
    head += b"property uchar red\nproperty uchar green\nproperty uchar blue\nelement face 0\n"
    head += b"property list uchar int vertex_indices\nend_header\n"
    kind = [("p", "<f4", 3), ("c", "u1", 3)]
    table = np.zeros(8, dtype=kind)
    table["p"], table["c"] = points, rng.integers(0, 256, (8, 3))
    swapped = table.astype([("p", ">f4", 3), ("c", "u1", 3)])
    text = "".join(f"{x} {y} {z} 255 9 0\n" for x, y, z in points).encode()
    cameras = [view.camera for view in model().views["train"]]
    splats = ply_bytes(fit_splats(PreparedScene(model().scene), cameras, 0.5).splats, model().units)
    return (
        ("points.ply", head % b"binary_little_endian" + table.tobytes()),
        ("points.ply", head % b"binary_big_endian" + swapped.tobytes()),
        ("points.ply", head % b"ascii" + text),
        ("splats.ply", splats),
    )


def make_ply(rng: Random) -> tuple[str, bytes]:
    name, data = rng.choice(ply_seeds())
    others = [other for _, other in ply_seeds()]
    if rng.random() < 0.5:  # a word of the header
        head, end, body = data.partition(b"end_header")
        words = head.split(b" ")
        strange = (
            *NUMBERS,
            "",
            "list",
            "vertex",
            "x",
            "float128",
            "ascii",
            "element",
            "property",
            "\n",
            "x" * 9_000,
            "\xff",
        )
        words[rng.randrange(len(words))] = rng.choice(strange).encode("latin-1", "replace")
        return name, b" ".join(words) + end + body
    return name, mutated(data, rng, others)


def read_either_ply(folder: Path, name: str, data: bytes) -> None:
    if name == "points.ply":
        read_ply(name, data)
        return
    (folder / name).write_bytes(data)
    read_splats(folder / name)


def compact_seeds() -> tuple[tuple[str, bytes], ...]:
    return (("model.graings", compact_seed()),)
