"""load_capture: which reader fits a folder, and its result in normalised units.

Knows the readers and nothing of the formats they read.
"""

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

    `transforms_*.json` is preferred over a COLMAP model where both lie there, and that over a lone `transforms.json`.
    Images are checked to be whole but not decoded (EXR excepted). Raises `CaptureError` naming file, field and remedy.
    """
    config = config or CaptureConfig()
    if not path.is_dir():
        raise CaptureError("is not a folder", file=path, remedy="Give the folder of a capture; unpack archives first.")
    found = _reader(path)
    if found is None:
        inner = [child for child in sorted(path.iterdir()) if _is_inner(child) and _reader(child)]
        if len(inner) != 1:
            raise _not_found(path, inner)
        path = inner[0]
        found = _reader(path)
    assert found is not None  # an inner folder is taken only where a reader fits
    folder = CaptureFolder(path)
    recording = found(folder, config)
    return normalize(recording, root=path, max_side=config.max_side, content_hash=folder.digest())


def _reader(path: Path) -> Reader | None:
    if any(path.glob("transforms_*.json")):
        return read_transforms
    if find_model(path) is not None:
        return read_colmap
    if (path / SINGLE_FILE).is_file():
        return read_single_transforms
    return None


def _is_inner(path: Path) -> bool:
    # A link could lead out of an unpacked archive; __MACOSX holds the ghosts of files.
    return path.is_dir() and not path.is_symlink() and not path.name.startswith((".", "__MACOSX"))


def _not_found(path: Path, inner: list[Path]) -> CaptureError:
    if inner:
        names = ", ".join(child.name for child in inner)
        return CaptureError(f"holds several captures ({names})", file=path, remedy="Give one of them.")
    return CaptureError(
        "holds no capture: neither transforms_train.json (D-NeRF, NeRF-synthetic) nor transforms.json (nerfstudio) nor "
        "a COLMAP model (cameras, images and points3D as .bin or .txt in sparse/0, sparse or the folder itself)",
        file=path,
        remedy="Give the folder that holds one of them.",
    )
