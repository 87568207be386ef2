"""Checkpoint: a model on disk, and everything needed to continue training it.

A run folder holds `checkpoints/<iteration>/` with `scene.safetensors` (the model), `state.safetensors` (what only
training needs) and `checkpoint.json` (the rest); `checkpoints/best/` holds the same of the iteration with the highest
held-out PSNR so far, which is the result where training diverges. A checkpoint appears whole or not at all: it is
written to a temporary folder, synced to disk and renamed. No pickle.
"""

from __future__ import annotations

import hashlib
import json
import logging
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor

from graings.camera.camera import View
from graings.camera.units import Units
from graings.config import TrainConfig
from graings.errors import CheckpointError
from graings.scene.scene import Scene
from graings.storage.files import sync, sync_tree
from graings.storage.model import DAMAGE, Model, model_facts, model_from
from graings.storage.run_folder import BEST, CHECKPOINTS, FACTS_FILE, checkpoints
from graings.storage.run_folder import best_checkpoint as best_checkpoint  # part of this module's interface too
from graings.storage.run_folder import newest_checkpoint as newest_checkpoint

FORMAT = "graings.checkpoint/1"
KEEP = 2

LOG = logging.getLogger(__name__)
Read = TypeVar("Read")

_REMEDY = "an earlier checkpoint is used if there is one, else train again"

_SCENE_FILE = "scene.safetensors"
_STATE_FILE = "state.safetensors"


@dataclass(frozen=True, slots=True, eq=False)
class TrainingState:
    """What only the trainer needs: tensors and JSON facts, opaque to this module."""

    tensors: dict[str, Tensor]
    facts: dict[str, Any]


def save_checkpoint(
    run: Path,
    *,
    scene: Scene,
    state: TrainingState,
    units: Units,
    background: Sequence[float],
    views: Mapping[str, Sequence[View]],
    config: TrainConfig,
    iteration: int,
    finished: bool,
    best: bool = False,
    instead_of_later: bool = False,
) -> Path:
    """Write a checkpoint and drop all but the last two. Returns its folder; `CheckpointError` on a full disk.

    `best` writes the one beside them that is kept until a better one comes. `instead_of_later` removes later ones
    as well, after training has diverged: this one is then the newest.
    """
    folder = run / CHECKPOINTS
    name = BEST if best else f"{iteration:08d}"
    final, part, old = folder / name, folder / f".{name}.part", folder / f".{name}.old"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        _put_back(folder)
        shutil.rmtree(part, ignore_errors=True)
        part.mkdir()
        save_file(_contiguous(scene.state_dict()), part / _SCENE_FILE)
        save_file(_contiguous(state.tensors), part / _STATE_FILE)
        facts = {
            "format": FORMAT,
            "digest": _digest(part / _SCENE_FILE),
            "state_digest": _digest(part / _STATE_FILE),
            **model_facts(
                scene=scene,
                units=units,
                background=background,
                views=views,
                config=config,
                iteration=iteration,
                finished=finished,
            ),
            "state": state.facts,
        }
        (part / FACTS_FILE).write_text(json.dumps(facts, allow_nan=False))
        sync_tree(part)
        if final.exists():
            # The best so far, or the same iteration again (the end right after a periodic checkpoint).
            final.rename(old)
        part.rename(final)
        shutil.rmtree(old, ignore_errors=True)
        sync(folder)
    except (OSError, SafetensorError) as error:  # the library has its own for a full disk
        shutil.rmtree(part, ignore_errors=True)
        _put_back(folder)
        raise CheckpointError(
            f"{final}: cannot write the checkpoint ({error}). Free some space; earlier ones are kept."
        ) from error
    kept = checkpoints(run)
    later = [one for one in kept if one.name > name] if instead_of_later else []
    kept = [one for one in kept if one not in later]
    for outdated in (*later, *kept[:-KEEP]):
        shutil.rmtree(outdated, ignore_errors=True)
    return final


def load_model(path: Path) -> Model:
    """The model in a checkpoint folder, or in the newest checkpoint of a run folder that can be read.

    Raises `CheckpointError`.
    """
    return _newest_readable(path, _model)


def load_training(path: Path) -> tuple[Model, TrainingState]:
    """As `load_model`, with what the trainer stored beside the model: both of the same checkpoint.

    For the only trainer of a run: it also completes what a process that died left half done.
    """
    if (path / CHECKPOINTS).is_dir():
        _put_back(path / CHECKPOINTS)
    return _newest_readable(path, lambda folder: (_model(folder), load_state(folder)))


def load_state(folder: Path) -> TrainingState:
    """What the trainer stored in a checkpoint folder. Raises `CheckpointError`."""
    try:
        facts = _read_facts(folder)
        return TrainingState(_tensors(folder / _STATE_FILE, facts["state_digest"]), facts["state"])
    except (OSError, SafetensorError, *DAMAGE) as error:
        raise CheckpointError(
            f"{folder}: damaged training state ({error!r}). Remove this folder; {_REMEDY}."
        ) from error


def _model(folder: Path) -> Model:
    facts = _read_facts(folder)
    try:
        digest = facts["digest"]
        return model_from(facts, _tensors(folder / _SCENE_FILE, digest), digest, folder)
    except (OSError, SafetensorError, *DAMAGE) as error:
        raise CheckpointError(f"{folder}: damaged checkpoint ({error!r}). Remove this folder; {_REMEDY}.") from error


def _tensors(file: Path, digest: str) -> dict[str, Tensor]:
    """The tensors in `file`. Raises `ValueError` where they are not those that were written."""
    if _digest(file) != digest:
        raise ValueError(f"{file.name} is not what was written")
    return load_file(file)


def _digest(file: Path) -> str:
    return hashlib.sha256(file.read_bytes()).hexdigest()


def _put_back(folder: Path) -> None:
    """Rename checkpoints back that were about to be replaced when the process died; remove those that were replaced."""
    for old in folder.glob(".*.old"):
        final = folder / old.name[1:].removesuffix(".old")
        if final.exists():
            shutil.rmtree(old, ignore_errors=True)
        else:
            old.rename(final)


def _newest_readable(path: Path, read: Callable[[Path], Read]) -> Read:
    """`read` of a checkpoint folder, or of a run's newest one that can be read; skipped ones are logged."""
    if (path / FACTS_FILE).is_file():
        return read(path)
    first: CheckpointError | None = None
    for folder in reversed(checkpoints(path)):
        try:
            found = read(folder)
        except CheckpointError as error:
            first = first or error
            continue
        if first is not None:
            LOG.warning("%s Continuing with %s.", first, folder)
        return found
    if first is not None:
        raise first
    raise CheckpointError(f"{path}: no checkpoint here. Give a run folder that has trained for a while.")


def _read_facts(folder: Path) -> dict[str, Any]:
    try:
        facts = json.loads((folder / FACTS_FILE).read_text())
    except (OSError, ValueError, RecursionError) as error:
        raise CheckpointError(
            f"{folder / FACTS_FILE}: not readable ({error}). Remove this folder; {_REMEDY}."
        ) from error
    if not isinstance(facts, dict) or facts.get("format") != FORMAT:
        raise CheckpointError(f"{folder / FACTS_FILE}: not in the format {FORMAT}. It was written by another version.")
    return facts


def _contiguous(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    return {name: tensor.detach().contiguous().clone() for name, tensor in tensors.items()}


@contextmanager
def intact(checkpoint: Path) -> Iterator[None]:
    """Raise `CheckpointError` about `checkpoint` where its contents do not fit."""
    try:
        yield
    except KeyError as error:
        raise CheckpointError(
            f"{checkpoint}: its training state lacks {error}: another version wrote it, or it is damaged. Continue "
            "with the version that wrote it, or train again; the model in it can be rendered."
        ) from error
    except DAMAGE as error:
        raise CheckpointError(
            f"{checkpoint}: damaged training state ({error!r}). Remove it to continue from an earlier one."
        ) from error
