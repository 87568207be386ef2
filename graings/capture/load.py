"""load_capture: chooses the reader for a folder and returns its capture in normalised units."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from graings.capture.capture import Capture
from graings.capture.folder import CaptureFolder
from graings.capture.normalize import normalize
from graings.capture.raw_capture import RawCapture
from graings.capture.readers.colmap import find_model, read_colmap
from graings.capture.readers.transforms import SINGLE_FILE, read_single_transforms, read_transforms
from graings.config import CaptureConfig
from graings.errors import CaptureError

Reader = Callable[[CaptureFolder, CaptureConfig], RawCapture]


def load_capture(path: Path, config: CaptureConfig | None = None) -> Capture:
    """The capture in the folder `path`, or in its only sub-folder that holds one.

    `transforms_*.json` is preferred over a COLMAP model where both exist, and a COLMAP model over `transforms.json`.
    Images are checked to be complete but not decoded (except EXR). Raises `CaptureError` naming file, field and remedy.
    """
    config = config or CaptureConfig()
    if not path.is_dir():
        raise CaptureError("is not a folder", file=path, remedy="Give the folder of a capture; unpack archives first.")
    reader = _reader(path)
    if reader is None:
        inner = [child for child in sorted(path.iterdir()) if _is_inner(child) and _reader(child)]
        if len(inner) != 1:
            raise _not_found(path, inner)
        path = inner[0]
        reader = _reader(path)
    assert reader is not None  # `inner` lists only folders with a reader
    folder = CaptureFolder(path)
    raw = reader(folder, config)
    return normalize(raw, root=path, max_side=config.max_side, content_hash=folder.digest())


def _reader(path: Path) -> Reader | None:
    if any(path.glob("transforms_*.json")):
        return read_transforms
    if find_model(path) is not None:
        return read_colmap
    if (path / SINGLE_FILE).is_file():
        return read_single_transforms
    return None


def _is_inner(path: Path) -> bool:
    # A link could lead out of an unpacked archive; __MACOSX holds only metadata of archives made on macOS.
    return path.is_dir() and not path.is_symlink() and not path.name.startswith((".", "__MACOSX"))


def _not_found(path: Path, inner: list[Path]) -> CaptureError:
    if inner:
        names = ", ".join(child.name for child in inner)
        return CaptureError(f"contains several captures ({names})", file=path, remedy="Give the folder of one of them.")
    return CaptureError(
        "contains no capture: neither transforms_train.json (D-NeRF, NeRF-synthetic) nor transforms.json (nerfstudio) "
        "nor a COLMAP model (cameras, images and points3D as .bin or .txt in sparse/0, sparse or the folder itself)",
        file=path,
        remedy="Give a folder that contains one of them.",
    )
