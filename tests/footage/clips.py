"""Clips for tests: a suite scene filmed by a camera on a smooth path, encoded by a real codec."""

from __future__ import annotations

import math
import struct
from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path

import numpy as np

from graings.capture.image_file import decode
from graings.capture.synthetic.catalogue import scene_named
from graings.capture.synthetic.drawing import draw
from graings.capture.synthetic.viewpoint import Viewpoint, look

FPS = 10


def film(
    name: str, frames: int, size: int, sweep: float = 1.2, turning: bool = False
) -> tuple[list[np.ndarray], list[Viewpoint]]:
    """Images [size, size, 3] uint8 and their cameras: an arc of `sweep` radians around the scene, rising slowly.

    A `turning` camera stays where it is and looks around.
    """
    world = scene_named(name).build(0)
    images, cameras = [], []
    for index in range(frames):
        share = index / max(frames - 1, 1)
        angle = -0.6 + sweep * share
        height = 0.5 + 0.5 * math.sin(2.0 * share)
        origin = (2.1 * math.cos(angle), 2.1 * math.sin(angle), height)
        target = (0.0, 0.0, -0.4)
        if turning:
            origin, target = (2.1, 0.0, 0.5), (0.0, 1.6 * share - 0.8, -0.4)
        camera = look(origin, target, 0.8, size)
        images.append(draw(world, camera, share).rgba[..., :3])
        cameras.append(camera)
    return images, cameras


def encode(
    path: Path,
    images: Iterable[np.ndarray],
    *,
    times: Iterable[float] | None = None,
    clockwise: bool = False,
    transfer: int | None = None,
    pixel_aspect: Fraction | None = None,
    matrix: str | None = None,
) -> Path:
    """Write `images` as H.264; `times` in seconds (default: FPS a second), `clockwise` marks the
    frames as to be turned by 90 degrees for display, as phones do; `transfer` is the code of the transfer function;
    pixels are `pixel_aspect` times as wide as high; the file does not name the `matrix` of its colours."""
    import av

    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=FPS, options={"crf": "12"})
        stream.pix_fmt = "yuv420p"
        stream.time_base = Fraction(1, 1000)
        stream.codec_context.time_base = Fraction(1, 1000)
        if transfer is not None:
            stream.codec_context.color_trc = transfer
        if pixel_aspect is not None:
            stream.codec_context.sample_aspect_ratio = pixel_aspect
        moments = iter(times) if times is not None else (index / FPS for index in range(1_000_000))
        for image, moment in zip(images, moments, strict=False):
            if not stream.codec_context.is_open:
                stream.height, stream.width = image.shape[:2]
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")
            frame = frame.reformat(format="yuv420p", dst_colorspace=matrix)
            frame.pts = round(moment * 1000)
            frame.time_base = Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    if clockwise:
        content = bytearray(path.read_bytes())
        start = content.index(b"tkhd") + 4 + 40  # the display matrix in the track's header
        one = 1 << 16
        content[start : start + 36] = struct.pack(">9i", 0, one, 0, -one, 0, 0, image.shape[0] << 16, 0, 1 << 30)
        path.write_bytes(content)
    return path


def read_png(path: Path) -> np.ndarray:
    """Pixels [H, W, C] in [0, 1]."""
    return decode(path, path.name)
