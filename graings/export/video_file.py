"""Video file: an encoder that is given one frame after the other.

PyAV (extra `video`) brings FFmpeg's encoders; a PNG file, which holds one frame, needs no extra.
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

from graings.errors import CheckpointError
from graings.image_encoding import encode_image
from graings.storage.files import sync, write_bytes


@dataclass(frozen=True, slots=True)
class Codec:
    """An encoder of FFmpeg with its pixel format, and its options and those of the container."""

    name: str
    pixels: str
    options: dict[str, str]
    container: dict[str, str]


# Quality is nearly constant (CRF); the tags say that colours are those of sRGB screens.
_TAGS: Final = {"colorspace": "bt709", "color_primaries": "bt709", "color_trc": "iec61966-2-1", "color_range": "tv"}
# Without it the macroblock tree of libx264 uses AVX-512 code whose results vary from run to run.
_REPRODUCIBLE: Final = {"x264-params": "cpu-independent=1"}
CODECS: Final = {
    ".mp4": Codec(
        "libx264", "yuv420p", {"crf": "16", "preset": "medium", **_TAGS, **_REPRODUCIBLE}, {"movflags": "+faststart"}
    ),
    ".webm": Codec("libvpx-vp9", "yuv420p", {"crf": "22", "b:v": "0", "row-mt": "1", "cpu-used": "4", **_TAGS}, {}),
    # Not libwebp_anim, which leaves faint traces of earlier frames where the background is seen again.
    ".webp": Codec("libwebp", "bgra", {"quality": "85"}, {"loop": "0"}),
    ".gif": Codec("gif", "pal8", {}, {"loop": "0"}),
    ".mkv": Codec("libx264rgb", "rgb24", {"qp": "0", "preset": "ultrafast"}, {}),  # lossless
}

MAX_FPS: Final = {".gif": 100.0}  # GIF counts hundredths of a second

Levels = NDArray[np.uint8]
AddFrame = Callable[[Levels], None]


def video_file(path: Path, width: int, height: int, fps: float) -> AbstractContextManager[AddFrame]:
    """A context with a function that adds a frame [height, width, 3] to the video `path`, which appears at its end.

    Raises `CheckpointError` where PyAV is missing or an encoder fails.
    """
    codec = CODECS.get(path.suffix.lower())
    return _picture(path) if codec is None else _encoder(path, codec, width, height, _rate(fps))


def encoder_version(path: Path) -> str:
    """The version of PyAV, which decides the bytes of a video; empty for what needs none. Raises `CheckpointError`."""
    return str(_import_av(path).__version__) if path.suffix else ""


def join(parts: Sequence[Path], frames: int, path: Path, fps: float) -> None:
    """Write videos of one codec and size, each of `frames` frames but the last, to `path` without encoding them anew.

    Raises `CheckpointError` for a part that cannot be read.
    """
    av, rate = _import_av(path), _rate(fps)
    container = CODECS[path.suffix.lower()].container
    with _whole(path, "joining") as part, av.open(str(part), "w", container_options=container) as output:
        stream: Any = None
        for index, file in enumerate(parts):
            for video, packet in _packets(file):
                stream = stream or output.add_stream_from_template(video)
                ticks = 1 / (rate * packet.time_base)  # of a frame; Matroska rounds times to milliseconds
                packet.pts = round((round(packet.pts / ticks) + index * frames) * ticks)
                packet.dts = round((round(packet.dts / ticks) + index * frames) * ticks)
                packet.stream = stream
                output.mux(packet)


def decoded(path: Path) -> Iterator[Levels]:
    """The frames [H, W, 3] of a video. Raises `CheckpointError` where it cannot be read."""
    with _opened(path) as source:
        for frame in source.decode(video=0):
            yield frame.to_ndarray(format="rgb24")


def _packets(path: Path) -> Iterator[tuple[Any, Any]]:
    """The stream of a video, with each of its packets."""
    with _opened(path) as source:
        video = source.streams.video[0]
        for packet in source.demux(video):
            if packet.pts is not None and packet.dts is not None:  # the last is empty
                yield video, packet


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    av = _import_av(path)
    try:
        with av.open(str(path)) as source:
            yield source
    except (av.FFmpegError, IndexError) as error:  # IndexError: it has no video
        raise CheckpointError(f"{path}: cannot be read ({error}). Remove it and make the video again.") from error


def _import_av(path: Path) -> Any:
    try:
        import av
        import av.filter
    except ModuleNotFoundError as error:
        raise CheckpointError(f"{path}: videos need the package av: pip install 'graings[video]'") from error
    return av


@contextmanager
def _picture(path: Path) -> Iterator[AddFrame]:
    yield lambda levels: write_bytes(path, encode_image(levels / np.float32(255.0)))


@contextmanager
def _encoder(path: Path, codec: Codec, width: int, height: int, rate: Fraction) -> Iterator[AddFrame]:
    av = _import_av(path)
    with _whole(path, codec.name) as part, av.open(str(part), "w", container_options=codec.container) as container:
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


@contextmanager
def _whole(path: Path, step: str) -> Iterator[Path]:
    """A name for the file until it is whole: then it replaces `path`."""
    av = _import_av(path)
    part = path.with_name(f".{path.stem}.part{path.suffix}")
    try:
        yield part
        sync(part)
        part.replace(path)
    except av.FFmpegError as error:
        raise CheckpointError(f"{path}: {step} failed ({error}). Choose another format or size.") from error
    finally:
        part.unlink(missing_ok=True)


def _rate(fps: float) -> Fraction:
    return Fraction(fps).limit_denominator(1001)


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
