"""Video: frames encoded as they are rendered, in the format that the file's name asks for.

PyAV (extra `video`) brings FFmpeg's encoders. A name without a suffix is a folder of PNG files and needs no extra.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from graings.camera.camera import Camera
from graings.errors import CheckpointError
from graings.export.shown import Shown
from graings.image_encoding import encode_image
from graings.render import render


@dataclass(frozen=True, slots=True)
class _Codec:
    name: str
    pixels: str
    options: dict[str, str]


# Quality is nearly constant (CRF); the tags say that colours are those of sRGB screens.
_TAGS: Final = {"colorspace": "bt709", "color_primaries": "bt709", "color_trc": "iec61966-2-1", "color_range": "tv"}
CODECS: Final[dict[str, _Codec]] = {
    ".mp4": _Codec("libx264", "yuv420p", {"crf": "16", "preset": "medium", **_TAGS}),
    ".webm": _Codec("libvpx-vp9", "yuv420p", {"crf": "22", "b:v": "0", "row-mt": "1", "cpu-used": "4", **_TAGS}),
    ".webp": _Codec("libwebp_anim", "bgra", {"quality": "85"}),
    ".gif": _Codec("gif", "pal8", {}),
}

_CONTAINERS: Final = {".mp4": {"movflags": "+faststart"}, ".webp": {"loop": "0"}, ".gif": {"loop": "0"}}

Levels = NDArray[np.uint8]


def check_video(path: Path) -> None:
    """Raises `ValueError` for a suffix that is not written."""
    if path.suffix.lower() not in ("", *CODECS):
        known = f"{', '.join(CODECS)}, or no suffix: a folder of PNG files"
        raise ValueError(f"{path.name}: videos of this kind are not written, choose one of {known}")


def write_video(
    path: Path,
    shown: Shown,
    frames: Sequence[tuple[Camera, float]],
    background: Sequence[float],
    *,
    fps: float = 30.0,
    observe: Callable[[int], None] = lambda done: None,
) -> None:
    """Render `frames`, each a camera and a time in [0, 1], on `background` into the file or folder `path`.

    `observe` is called with the number of frames that are done. An existing file is replaced when the video is whole.
    Codecs with subsampled colour need even sides: an odd one loses a pixel. Raises `ValueError` for a rate out of
    range, `CheckpointError` where PyAV is missing or an encoder fails.
    """
    check_video(path)
    if not 0 < fps <= 240:
        raise ValueError(f"fps must lie in (0, 240], got {fps}")
    codec = CODECS.get(path.suffix.lower())
    even = codec is not None and codec.pixels == "yuv420p"
    width, height = (side - side % 2 if even else side for side in (frames[0][0].width, frames[0][0].height))
    if min(width, height) < 1:
        raise ValueError(f"{path.suffix} needs at least 2 x 2 pixels")
    with video_file(path, width, height, fps) as add:
        for index, (camera, time) in enumerate(frames):
            color = render(shown.scene, camera.resized(width, height), time, background).color.numpy()
            add(np.rint(np.clip(color, 0.0, 1.0) * 255.0).astype(np.uint8))
            observe(index + 1)


def video_file(path: Path, width: int, height: int, fps: float) -> AbstractContextManager[Callable[[Levels], None]]:
    """A context with a function that adds a frame [height, width, 3] to the video at `path`, whole at its end."""
    codec = CODECS.get(path.suffix.lower())
    return _folder(path) if codec is None else _encoder(path, codec, width, height, fps)


@contextmanager
def _folder(path: Path) -> Iterator[Callable[[Levels], None]]:
    path.mkdir(parents=True, exist_ok=True)
    count = 0

    def add(levels: Levels) -> None:
        nonlocal count
        (path / f"{count:05d}.png").write_bytes(encode_image(levels / np.float32(255.0)))
        count += 1

    yield add


@contextmanager
def _encoder(path: Path, codec: _Codec, width: int, height: int, fps: float) -> Iterator[Callable[[Levels], None]]:
    try:
        import av
        import av.filter
    except ModuleNotFoundError as error:
        raise CheckpointError(f"{path}: videos need the package av: pip install 'graings[video]'") from error
    rate = Fraction(fps).limit_denominator(1001)
    part = path.with_name(f".{path.stem}.part{path.suffix}")
    try:
        with av.open(str(part), "w", container_options=_CONTAINERS.get(path.suffix.lower(), {})) as container:
            stream: Any = container.add_stream(codec.name, rate=rate, options=codec.options)
            stream.width, stream.height, stream.pix_fmt = width, height, codec.pixels
            palette = _palette(av.filter.Graph(), width, height, rate) if codec.name == "gif" else None
            count = 0

            def add(levels: Levels) -> None:
                nonlocal count
                frame: Any = av.VideoFrame.from_ndarray(levels, format="rgb24")
                if palette is not None:
                    palette.push(frame)
                    frame = palette.pull()
                elif codec.pixels == "yuv420p":
                    frame = frame.reformat(format=codec.pixels, dst_colorspace="ITU709")
                frame.pts, frame.time_base = count, 1 / rate
                count += 1
                container.mux(stream.encode(frame))

            yield add
            container.mux(stream.encode())
        part.replace(path)
    except av.FFmpegError as error:
        raise CheckpointError(f"{path}: {codec.name} failed ({error}). Choose another format or size.") from error
    finally:
        part.unlink(missing_ok=True)


def _palette(graph: Any, width: int, height: int, rate: Fraction) -> Any:
    """A filter that gives each frame its own 256 colours."""
    source = graph.add_buffer(width=width, height=height, format="rgb24", time_base=1 / rate)
    split, made = graph.add("split"), graph.add("palettegen", "stats_mode=single")
    used, sink = graph.add("paletteuse", "new=1:dither=bayer:bayer_scale=4"), graph.add("buffersink")
    source.link_to(split)
    split.link_to(made, 0)
    split.link_to(used, 1, 0)
    made.link_to(used, 0, 1)
    used.link_to(sink)
    graph.configure()
    return graph
