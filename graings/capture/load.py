"""load_capture: finds the capture in a folder, chooses its reader and returns it in normalised units."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Final

from graings.capture.capture import ALL_SPLITS, Capture
from graings.capture.folder import CaptureFolder
from graings.capture.normalize import normalize
from graings.capture.orientation import orientation_notes
from graings.capture.raw_capture import RawCapture
from graings.capture.readers.colmap import read_colmap
from graings.capture.readers.colmap_folder import find_model, picture_folder
from graings.capture.readers.foreign import recognised
from graings.capture.readers.nerfies import is_nerfies, read_nerfies
from graings.capture.readers.poses_bounds import FILE as POSES_BOUNDS
from graings.capture.readers.poses_bounds import read_poses_bounds
from graings.capture.readers.transforms import read_single_transforms, read_transforms, split_file
from graings.capture.readers.transforms_document import SINGLE_FILE
from graings.config import CaptureConfig
from graings.errors import CaptureError

Reader = Callable[[CaptureFolder, CaptureConfig], RawCapture]

# So many folders deep a capture is looked for: dense/0 of COLMAP within the folder of an archive.
MAX_DEPTH: Final = 4


def load_capture(path: Path, config: CaptureConfig | None = None) -> Capture:
    """The capture in the folder `path`, or in the only folder below it that holds one.

    `transforms_train.json` is preferred over a COLMAP model where both exist, and a COLMAP model over
    `transforms.json`. Images are checked to be complete; only formats without an end marker are decoded. Raises
    `CaptureError` naming file, field and remedy.
    """
    config = config or CaptureConfig()
    if not path.is_dir():
        raise CaptureError("is not a folder", file=path, remedy="Give the folder of a capture; unpack archives first.")
    root, reader = find_capture(path)
    folder = CaptureFolder(root)
    raw = reader(folder, config)
    images = [frame.image for split in ALL_SPLITS for frame in raw.splits.get(split, ())]
    raw = raw.noted(*folder.notes(), *orientation_notes(images))
    return normalize(raw, root=root, max_side=config.max_side, content_hash=folder.digest())


def holds_capture(path: Path) -> bool:
    """Whether the folder `path` itself has the files of a capture, complete or not."""
    return _reader(path) is not None


def find_capture(path: Path) -> tuple[Path, Reader]:
    """The folder of the capture at or below `path`, the one least deep, and its reader. Raises `CaptureError`."""
    level, incomplete = [path], None
    for _ in range(MAX_DEPTH + 1):
        found = [(folder, reader) for folder in level if (reader := _reader(folder)) is not None]
        complete = [(folder, reader) for folder, reader in found if _has_pictures(folder, reader)]
        if len(complete) > 1:
            raise _several(path, [folder for folder, _ in complete])
        if complete:
            return complete[0]
        incomplete = incomplete or (found[0] if found else None)
        level = [child for folder in level for child in sorted(folder.iterdir()) if _is_inner(child)]
    if incomplete is not None:
        return incomplete  # its reader names what is missing
    raise _not_found(path)


def _reader(path: Path) -> Reader | None:
    names = {child.name for child in path.iterdir()}
    if split_file("train") in names:
        return read_transforms
    if is_nerfies(names):
        return read_nerfies
    if find_model(path) is not None:
        return read_colmap
    if SINGLE_FILE in names:
        return read_single_transforms
    if POSES_BOUNDS in names:
        return read_poses_bounds
    return read_transforms if any(split_file(split) in names for split in ALL_SPLITS) else None


def _has_pictures(path: Path, reader: Reader) -> bool:
    """False for a COLMAP model without pictures beside it: those of COLMAP's dense/0 lie with a copy of the model."""
    model = find_model(path) if reader is read_colmap else None
    return model is None or any(
        (path / picture_folder(path, model.folder, name)).is_dir()
        for name in ("images", "images_2", "images_4", "images_8")
    )


def _is_inner(path: Path) -> bool:
    # A link could lead out of an unpacked archive; __MACOSX holds only metadata of archives made on macOS.
    return path.is_dir() and not path.is_symlink() and not path.name.startswith((".", "__MACOSX"))


def _several(path: Path, found: list[Path]) -> CaptureError:
    names = ", ".join(str(folder.relative_to(path)) for folder in found)
    return CaptureError(f"contains several captures ({names})", file=path, remedy="Give the folder of one of them.")


def _not_found(path: Path) -> CaptureError:
    inner = [child for child in sorted(path.iterdir()) if _is_inner(child)]
    foreign = next((known for folder in (path, *inner) if (known := recognised(folder)) is not None), None)
    if foreign is not None:
        way_in = foreign.way_in[0].upper() + foreign.way_in[1:]
        return CaptureError(f"holds {foreign.name}, which is not read", file=path, remedy=f"{way_in}.")
    return CaptureError(
        "contains no capture: neither transforms_train.json (D-NeRF, NeRF-synthetic) nor transforms.json (nerfstudio) "
        "nor a COLMAP model (cameras, images and points3D as .bin or .txt in sparse/0, sparse or the folder itself) "
        "nor dataset.json with camera/ (Nerfies, HyperNeRF, DyCheck) nor poses_bounds.npy (LLFF, Neural-3D-Video)",
        file=path,
        remedy="Give a folder that contains one of them.",
    )
