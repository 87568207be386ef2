"""Where a COLMAP folder keeps its models and pictures: `sparse/0` beside `images/`, and other layouts."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from graings.capture.readers.colmap_model import is_image_line

# Folders that hold a model, or numbered folders with one each; the first with a model is read. `distorted` is what
# 3DGS's convert.py keeps of the photos before it undistorts them.
MODEL_FOLDERS: Final = ("sparse", ".", "colmap/sparse", "colmap", "distorted/sparse")

IMAGES: Final = "images"
MASKS: Final = "masks"


@dataclass(frozen=True, slots=True)
class ModelFolder:
    """A model: its `folder` relative to the capture, and others beside it with fewer registered images."""

    folder: str
    registered: int
    smaller: tuple[tuple[str, int], ...] = ()

    def notes(self) -> list[str]:
        """A note on the models that are not read."""
        if not self.smaller:
            return []
        others = ", ".join(f"{folder} with {count}" for folder, count in self.smaller)
        return [f"the model {self.folder} with {self.registered} images is read; not read: {others}"]


def find_model(root: Path) -> ModelFolder | None:
    """The model in the capture `root` with the most registered images; None without one."""
    for parent in MODEL_FOLDERS:
        numbered = sorted(child.name for child in (root / parent).glob("[0-9]*") if child.is_dir())
        folders = [str(Path(parent, name)) for name in numbered] + [parent]
        found = [(folder, _registered(root / folder)) for folder in folders if _has_model(root / folder)]
        if found:
            best = max(found, key=lambda item: item[1])
            return ModelFolder(*best, tuple(item for item in found if item != best))
    return None


def picture_folder(root: Path, model: str, name: str = IMAGES) -> str:
    """The folder `name` with the pictures of a model: beside the model, or beside a folder that it lies in."""
    places = list(_above(model))
    return next((place for place in places if (root / place).is_dir()), places[-1]).replace(IMAGES, name)


def _above(model: str) -> Iterator[str]:
    for parent in (Path(model), *Path(model).parents):
        yield str(parent / IMAGES)


def _has_model(folder: Path) -> bool:
    return any((folder / f"cameras{suffix}").is_file() for suffix in (".bin", ".txt"))


def _registered(folder: Path) -> int:
    """Number of registered images as the file declares it; 0 where it does not, which the reader will refuse."""
    binary, text = folder / "images.bin", folder / "images.txt"
    if binary.is_file():
        with binary.open("rb") as file:
            head = file.read(8)
        return int(struct.unpack("<Q", head)[0]) if len(head) == 8 else 0
    if not text.is_file():
        return 0
    with text.open(errors="surrogateescape") as lines:
        return sum(1 for line in lines if not line.startswith("#") and is_image_line(line))
