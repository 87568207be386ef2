"""Kinds of input: how each is made, and how our reader for it is called."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from random import Random
from typing import Any

from fuzzing import archives, captures, images, models


@dataclass(frozen=True, slots=True)
class Kind:
    """`valid` are the seeds, which are read; `make` gives name and content of an input.

    `open` prepares a folder, and `read` reads an input in it.
    A message must have one of the names in `named`, and may have the path `given` to the reader but no other.
    """

    name: str
    valid: Callable[[], tuple[tuple[str, bytes], ...]]
    make: Callable[[Random], tuple[str, bytes]]
    read: Callable[[Any, str, bytes], None]
    open: Callable[[Path], Any] = lambda folder: folder
    named: Callable[[str], tuple[str, ...]] = lambda name: (name,)
    given: Callable[[Path, str], Path] = lambda folder, name: folder / name


def _anything(name: str) -> tuple[str, ...]:
    """An archive is the body of a request: it has no name."""
    return ("",)


def _checkpoint(folder: Path, name: str) -> Path:
    return folder / "00000007"


def _capture(name: str, make: Callable[[Random], tuple[str, bytes]], *suffixes: str) -> Kind:
    """A kind of file of a capture, found by its suffixes."""

    def valid() -> tuple[tuple[str, bytes], ...]:
        return captures.valid(*suffixes)

    return Kind(name, valid, make, captures.read, captures.open_folder, captures.named, captures.given)


KINDS = {
    kind.name: kind
    for kind in (
        Kind("archives", archives.valid, archives.make, archives.read, archives.open_folder, _anything),
        Kind("images", images.seeds, images.make, images.read),
        Kind("photographs", images.photographs, images.make_photograph, images.read_photograph),
        _capture("json", captures.make_json, ".json"),
        _capture("arrays", captures.make_arrays, ".npy"),
        _capture("colmap", captures.make_colmap, ".bin", ".txt"),
        Kind("ply", models.ply_seeds, models.make_ply, models.read_either_ply),
        Kind(
            "safetensors",
            lambda: tuple(models.checkpoint_seeds().items()),
            models.make_safetensors,
            models.read_checkpoint,
            models.open_checkpoint,
            lambda name: ("00000007",),
            _checkpoint,
        ),
        Kind("graings", models.compact_seeds, models.make_compact, models.read_model),
    )
}
