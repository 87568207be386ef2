"""Frames of a video: spread evenly over its length, the sharpest of each interval, upright, at their own times."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from graings.errors import CaptureError
from graings.footage.frame_document import FootageFrame
from graings.footage.sharpness import WIDTH, sharpness
from graings.image_encoding import encode_image
from graings.storage.files import write_bytes

if TYPE_CHECKING:
    import av

# Transfer functions of HDR video (ITU-T H.273): PQ and HLG. Shown as SDR they are grey and flat.
HDR_TRANSFERS: Final = {16: "PQ", 18: "HLG"}

# A video that names no colour matrix (2 in ITU-T H.273) has that of Rec. 709 if it is higher than PAL, as in players.
UNSPECIFIED: Final = 2
PAL_HEIGHT: Final = 576

PNG_LEVEL: Final = 1

# Of an interval: a frame exactly at its start must not fall into the one before.
ROUNDING: Final = 1e-6


@dataclass(slots=True)
class _Candidate:
    frame: Any
    time: float
    sharpness: float


def extract_frames(
    video: Path, target: Path, count: int, max_side: int, observe: Callable[[int, int], None]
) -> tuple[int, tuple[FootageFrame, ...]]:
    """Write at most `count` frames of `video` to the folder `target` as PNG, no side above `max_side` px.

    Times are the presentation times of the frames, so a variable frame rate is respected; the rotation that phones
    store is applied, and pixels that are not square become square. Returns how many frames the video has, and those
    written. Raises `CaptureError` for what is no video, for HDR video, and without the package PyAV.
    """
    try:
        import av  # optional extra [video]
    except ModuleNotFoundError as error:
        remedy = "Install it: pip install 'graings[video]'. Or give a folder of images."
        raise CaptureError("reading a video needs the package PyAV", file=video, remedy=remedy) from error
    try:
        with av.open(str(video)) as container:
            return _extract(container, video, target, count, max_side, observe)
    except av.FFmpegError as error:
        remedy = "Convert it to MP4 (H.264), or give a folder of its frames."
        raise CaptureError(f"is no video that can be decoded ({error.strerror})", file=video, remedy=remedy) from error


def _extract(
    container: av.container.InputContainer,
    video: Path,
    target: Path,
    count: int,
    max_side: int,
    observe: Callable[[int, int], None],
) -> tuple[int, tuple[FootageFrame, ...]]:
    if not container.streams.video:
        raise CaptureError("has no video track", file=video, remedy="Give a video, or a folder of images.")
    stream = container.streams.video[0]
    stream.thread_type = "AUTO"
    duration = _duration(container, stream)
    if duration is None:
        raise CaptureError("does not say how long it is", file=video, remedy="Convert it to MP4 (H.264).")
    aspect = float(stream.sample_aspect_ratio or 1)
    written: list[FootageFrame] = []
    best: _Candidate | None = None
    interval, seen, start = 0, 0, 0.0
    for frame in container.decode(stream):
        if frame.time is None:
            continue
        if seen == 0:
            start = frame.time
            _refuse_hdr(frame, video)
        seen += 1
        time = frame.time - start
        current = min(int(time / duration * count + ROUNDING), count - 1)
        if best is not None and current != interval:
            written.append(_write(best, target, len(written), max_side, aspect))
            observe(current, count)
            best = None
        interval = current
        value = sharpness(_luma(frame))
        if best is None or value > best.sharpness:
            best = _Candidate(frame, time, value)
    if best is not None:
        written.append(_write(best, target, len(written), max_side, aspect))
    return seen, tuple(written)


def _duration(container: Any, stream: Any) -> float | None:
    """Seconds, from the track or else from the file."""
    if stream.duration:
        return float(stream.duration * stream.time_base)
    return container.duration / 1e6 if container.duration else None


def _refuse_hdr(frame: Any, video: Path) -> None:
    transfer = HDR_TRANSFERS.get(int(frame.color_trc))
    if transfer is not None:
        remedy = "Export it as SDR (Rec. 709), or switch HDR video off when recording."
        raise CaptureError(f"is HDR video ({transfer}), whose colours would come out wrong", file=video, remedy=remedy)


def _luma(frame: Any) -> NDArray[np.uint8]:
    width = min(WIDTH, frame.width)
    height = max(1, round(frame.height * width / frame.width))
    luma: NDArray[np.uint8] = frame.reformat(width=width, height=height, format="gray").to_ndarray()
    return luma


def _write(candidate: _Candidate, target: Path, index: int, max_side: int, aspect: float) -> FootageFrame:
    """Write the frame with square pixels; those of the video are `aspect` times as wide as they are high."""
    frame = candidate.frame
    shown = frame.width * aspect
    scale = min(1.0, max_side / max(shown, frame.height))
    width, height = max(1, round(shown * scale)), max(1, round(frame.height * scale))
    untagged = frame.colorspace == UNSPECIFIED
    matrix = "ITU709" if untagged and frame.height > PAL_HEIGHT else None  # None: Rec. 601 unless the video says more
    shape = {"width": width, "height": height, "format": "rgb24", "interpolation": "AREA"}
    pixels = frame.reformat(**shape, src_colorspace=matrix).to_ndarray()
    upright = np.rot90(pixels, k=round(frame.rotation / 90) % 4)
    name = f"{index:05d}.png"
    content = encode_image(upright.astype(np.float32) / 255, "png", png_level=PNG_LEVEL)
    write_bytes(target / name, content)
    return FootageFrame(name=name, time=candidate.time, sharpness=candidate.sharpness)
