"""The compact file: a model as one small file that is enough to render it.

Features and opacity offsets are rounded to float16 where they fit, anchors that no camera at any time can see are left
out, uids become ranks, and the whole is compressed with gzip. Networks and everything that positions a Gaussian stay in
float32: otherwise two Gaussians at nearly the same depth could swap their order, which changes a pixel by up to 0.1.
"""

from __future__ import annotations

import gzip
import hashlib
import io
import json
import zlib
from pathlib import Path
from typing import Final

import torch
from jaxtyping import Bool, Float
from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor

from graings import constants
from graings.errors import CheckpointError, OutputError
from graings.scene.scaffold import Scaffold, per_slot
from graings.scene.scene import Scene
from graings.storage.checkpoint import load_model
from graings.storage.files import check_writable, write_bytes
from graings.storage.model import DAMAGE, Model, model_facts, model_from
from graings.storage.run_folder import newest_model

FORMAT: Final = "graings.model/1"
SUFFIX: Final = ".graings"

_FACTS: Final = "graings"

# A model unpacks to one and a half times its size. Up to so many bytes any ratio is harmless.
_MAX_RATIO: Final = 20
_ANY_SIZE: Final = 64 << 20

# Rows of the scaffold for which float16 is enough.
_HALVED: Final = ("features", "opacity_offsets")


def write_compact(model: Model, path: Path) -> int:
    """Write `model` to the file `path`, whole or not at all; returns its size in bytes.

    Raises `OutputError` where the file cannot be written.
    """
    check_writable(path)
    tensors = {name: tensor.detach() for name, tensor in model.scene.state_dict().items()}
    for name in _HALVED:
        halved = tensors[f"scaffold.{name}"].half()
        if bool(halved.isfinite().all()):  # float16 ends at 65 504; larger values must not become infinite
            tensors[f"scaffold.{name}"] = halved
    order = tensors["scaffold.uids"].argsort()
    # Tested on the values that are written, so that a file read and written again is the same file.
    seen = can_be_seen(model.scene, *(tensors[f"scaffold.{name}"].float() for name in _HALVED))
    order = order[seen[order]]
    for name in Scaffold.ROWS:
        tensors[f"scaffold.{name}"] = tensors[f"scaffold.{name}"][order]
    # Ties of depth are broken by uid; the order of rows in the file preserves that order.
    del tensors["scaffold.uids"]
    facts = model_facts(
        scene=model.scene,
        units=model.units,
        background=model.background,
        views=model.views,
        config=model.config,
        iteration=model.iteration,
        finished=model.finished,
    )
    plain = {name: tensor.contiguous() for name, tensor in tensors.items()}
    # One metadata entry, because the library writes several in random order.
    data = save(plain, {_FACTS: json.dumps({"format": FORMAT, **facts}, allow_nan=False)})
    packed = gzip.compress(data, mtime=0)
    try:
        write_bytes(path, packed)
    except OSError as error:
        raise OutputError(f"{path}: cannot write the model ({error.strerror}). Name another place.") from error
    return len(packed)


def read_compact(path: Path) -> Model:
    """The model in the file `path`, in float32. Raises `CheckpointError`."""
    try:
        packed = path.read_bytes()
        data = _unpacked(packed)
        size = int.from_bytes(data[:8], "little")
        facts = json.loads(json.loads(data[8 : 8 + size])["__metadata__"][_FACTS])
        if facts["format"] != FORMAT:
            raise CheckpointError(f"{path}: not in the format {FORMAT}. It was written by another version.")
        tensors = load(data)
        tensors = {name: tensor.float() for name, tensor in tensors.items()}
        tensors["scaffold.uids"] = torch.arange(len(tensors["scaffold.anchors"]))
        return model_from(facts, tensors, hashlib.sha256(packed).hexdigest(), path)
    except (OSError, EOFError, zlib.error, SafetensorError, *DAMAGE) as error:
        raise CheckpointError(f"{path}: no model, or a damaged one ({error}). Export it again.") from error


def _unpacked(packed: bytes) -> bytes:
    """The content of a gzip file. Raises `ValueError` for one that would fill the memory."""
    most = max(_ANY_SIZE, _MAX_RATIO * len(packed))
    with gzip.open(io.BytesIO(packed)) as file:
        data = file.read(most + 1)
    if len(data) > most:
        raise ValueError(f"it unpacks to more than {_MAX_RATIO} times its size")
    return data


def open_model(path: Path) -> Model:
    """The model in a file of `write_compact`, or in a run or checkpoint folder. Raises `CheckpointError`.

    A run whose checkpoints were removed to save space has its compact file still.
    """
    found = path if path.is_file() else newest_model(path)
    return read_compact(found) if found is not None and found.is_file() else load_model(path)


def can_be_seen(
    scene: Scene,
    features: Float[Tensor, "anchor feature"],
    opacity_offsets: Float[Tensor, " anchor"] | Float[Tensor, "anchor child"],
) -> Bool[Tensor, " anchor"]:
    """Which anchors have a child that may be drawn at some time from some camera; the others never change a pixel."""
    with torch.no_grad():
        logits = scene.appearance.highest_opacity_logits(features)
        highest = torch.tanh(logits + per_slot(opacity_offsets)).amax(-1)
    # The residual of opacity is bounded; one hundredth more covers rounding.
    reach = 1.01 * scene.residual.scale if scene.residual is not None else 0.0
    return highest > constants.ALPHA_MIN - reach
