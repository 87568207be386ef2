"""Video: frames encoded as they are rendered, in the format that the file's name asks for.

A name without a suffix is a folder of PNG files.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

import numpy as np

from graings.camera.camera import Camera
from graings.export.shown import Shown
from graings.export.video_file import CODECS, MAX_FPS, encoder_version, video_file
from graings.export.video_parts import open_parts
from graings.render import render

FORMATS: Final = (".mp4", ".webm", ".webp", ".gif")
MIN_FPS: Final = 0.1  # frames per second
FPS: Final = 240.0


def check_video(path: Path, fps: float) -> None:
    """Raises `ValueError` for a suffix that is not written, and for a rate that its format does not have."""
    suffix = path.suffix.lower()
    if suffix not in ("", *FORMATS):
        known = f"{', '.join(FORMATS)}, or no suffix: a folder of PNG files"
        raise ValueError(f"{path.name}: videos of this kind are not written, choose one of {known}")
    most = MAX_FPS.get(suffix, FPS)
    if not MIN_FPS <= fps <= most:
        of = f" for a {suffix} file" if suffix in MAX_FPS else ""
        raise ValueError(f"fps must lie in [{MIN_FPS:g}, {most:g}]{of}, got {fps:g}")


def video_size(path: Path, camera: Camera) -> tuple[int, int]:
    """Width and height in px of the video `path` of what `camera` sees.

    Codecs with subsampled colour need even sides: an odd one loses a pixel. Raises `ValueError` where none is left.
    """
    codec = CODECS.get(path.suffix.lower())
    even = codec is not None and codec.pixels == "yuv420p"
    width, height = (side - side % 2 if even else side for side in (camera.width, camera.height))
    if min(width, height) < 1:
        raise ValueError(f"{path.suffix} needs at least 2 x 2 pixels")
    return width, height


def write_video(
    path: Path,
    shown: Shown,
    frames: Sequence[tuple[Camera, float]],
    background: Sequence[float],
    *,
    fps: float = 30.0,
    observe: Callable[[int], None] = lambda done: None,
) -> int:
    """Render `frames`, each a camera and a time in [0, 1], on `background` into the file or folder `path`.

    `observe` is called with the number of frames that are done. An existing file is replaced when the video is whole.
    A call that was interrupted goes on where it was when it is repeated (`graings.export.video_parts`); returned is how
    many frames were rendered by this call. All frames have the size `video_size` of the first.
    Raises `ValueError` for a rate out of range, `CheckpointError` where PyAV is missing, an encoder fails, or another
    process makes this video.
    """
    check_video(path, fps)
    width, height = video_size(path, frames[0][0])
    frames = [(camera.resized(width, height), time) for camera, time in frames]
    identity = _identity(frames, (encoder_version(path), shown.digest, *background, fps))
    rendered = 0
    with open_parts(path, identity) as parts:
        for first in range(0, len(frames), parts.frames):
            chosen = frames[first : first + parts.frames]
            if parts.file(first).exists():
                observe(first + len(chosen))
                continue
            with video_file(parts.file(first), width, height, fps) as add:
                for done, (camera, time) in enumerate(chosen, first + 1):
                    color = render(shown.scene, camera, time, background).color.numpy()
                    add(np.rint(np.clip(color, 0.0, 1.0) * 255.0).astype(np.uint8))
                    observe(done)
            rendered += len(chosen)
        parts.finish(len(frames), width, height, fps)
    return rendered


def _identity(frames: Sequence[tuple[Camera, float]], others: Sequence[object]) -> str:
    """sha256 of all that decides what the video looks like."""
    digest = hashlib.sha256(repr((CODECS, *others)).encode())
    for camera, time in frames:
        numbers = (camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height, time)
        digest.update(camera.world_to_camera.tobytes() + repr(numbers).encode())
    return digest.hexdigest()
