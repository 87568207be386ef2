"""Images: every format that captures are read in, checked and decoded as those of a capture are."""

from __future__ import annotations

import struct
import tempfile
import zlib
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from random import Random

import numpy as np
import OpenImageIO as oiio

from fuzzing.mutations import WIDE, mutated
from graings.capture.image_file import PNG_SIGNATURE, check_image, decode
from graings.footage.photos import SUFFIXES, convert_photographs

# Suffix, channels, type and compression.
KINDS = (
    *(("png", 4, "uint8", ""), ("png", 3, "uint16", ""), ("png", 1, "uint8", ""), ("jpg", 3, "uint8", "")),
    *(("exr", 4, "half", "zip"), ("exr", 3, "float", "piz"), ("exr", 3, "half", "none"), ("exr", 3, "half", "dwaa")),
    *(
        ("tif", 4, "uint8", "lzw"),
        ("tif", 3, "uint16", "zip"),
        ("tif", 3, "float", "none"),
        ("tif", 3, "uint8", "jpeg"),
    ),
    *(("webp", 4, "uint8", ""), ("bmp", 3, "uint8", ""), ("gif", 3, "uint8", ""), ("tga", 4, "uint8", "rle")),
)


@cache
def seeds() -> tuple[tuple[str, bytes], ...]:
    rng = np.random.default_rng(0)
    made = []
    with tempfile.TemporaryDirectory() as folder:
        for number, (suffix, channels, kind, compression) in enumerate(KINDS):
            path = Path(folder) / f"{number}.{suffix}"
            spec = oiio.ImageSpec(24, 16, channels, kind)
            if compression:
                spec["compression"] = compression
            output = oiio.ImageOutput.create(str(path))
            assert output.open(str(path), spec), output.geterror()
            assert output.write_image(rng.random((16, 24, channels), dtype=np.float32)), output.geterror()
            assert output.close()
            made.append((f"image{number}.{suffix}", path.read_bytes()))
    return tuple(made)


def png_chunks(data: bytes) -> list[tuple[bytes, bytes]]:
    chunks, at = [], 8
    while at + 12 <= len(data):
        size = int.from_bytes(data[at : at + 4], "big")
        chunks.append((data[at + 4 : at + 8], data[at + 8 : at + 8 + size]))
        at += 12 + size
    return chunks


@cache
def bomb(side: int) -> bytes:
    """A PNG of a few hundred kilobytes with side x side transparent pixels."""
    rows = zlib.compressobj(9)
    parts = [rows.compress(bytes(4 * side + 1)) for _ in range(side)] + [rows.flush()]
    header = struct.pack(">2I5B", side, side, 8, 6, 0, 0, 0)
    return _png(((b"IHDR", header), (b"IDAT", b"".join(parts)), (b"IEND", b"")))


def _png(chunks: Sequence[tuple[bytes, bytes]]) -> bytes:
    parts = [struct.pack(">I", len(c)) + k + c + struct.pack(">I", zlib.crc32(k + c)) for k, c in chunks]
    return PNG_SIGNATURE + b"".join(parts)


def lying_png(data: bytes, rng: Random) -> bytes:
    """Chunks with other contents, in another order, or bombs, all with the right check sums."""
    chunks = png_chunks(data)
    place = rng.randrange(len(chunks))
    kind, content = chunks[place]
    action = rng.randrange(6)
    if action == 0:
        size = (rng.choice(WIDE) % (1 << 32)).to_bytes(4, "big")
        offset = rng.choice((0, 4))
        header = bytearray(chunks[0][1])
        header[offset : offset + 4] = rng.choice((size, struct.pack(">I", rng.choice((4_000, 8_192, 30_000)))))
        chunks[0] = (b"IHDR", bytes(header))
    elif action == 1:
        header = bytearray(chunks[0][1])
        header[rng.randrange(8, 13)] = rng.randrange(256)
        chunks[0] = (b"IHDR", bytes(header))
    elif action == 2:
        bomb = zlib.compress(bytes(rng.choice((1 << 10, 1 << 20, 1 << 25))), 9)
        name = rng.choice((b"zTXt", b"iCCP", b"iTXt", b"IDAT"))
        chunks.insert(1, (name, (b"" if name == b"IDAT" else b"a\0\0") + bomb))
    elif action == 3:
        chunks[place] = (kind, mutated(content, rng, [content]))
    elif action == 4:
        rng.shuffle(chunks)
    else:
        chunks.insert(
            place, (rng.choice((b"PLTE", b"tRNS", b"eXIf", b"acTL", b"sRGB", b"gAMA", kind)), rng.randbytes(30))
        )
    return _png(chunks)


def lying_jpeg(data: bytes, rng: Random) -> bytes:
    """Another size or number of components in the frame header."""
    changed = bytearray(data)
    for marker in (b"\xff\xc0", b"\xff\xc2"):
        at = data.find(marker)
        if at >= 0:
            offset, size = rng.choice(((2, 2), (4, 1), (5, 2), (7, 2), (9, 1), (11, 1)))
            changed[at + offset : at + offset + size] = (rng.choice(WIDE) % (1 << 8 * size)).to_bytes(size, "big")
    return bytes(changed)


def photographs() -> tuple[tuple[str, bytes], ...]:
    """The seeds that footage may have."""
    return tuple((name, data) for name, data in seeds() if Path(name).suffix in SUFFIXES)


def make(rng: Random) -> tuple[str, bytes]:
    return _made(rng, seeds())


def make_photograph(rng: Random) -> tuple[str, bytes]:
    return _made(rng, photographs())


def _made(rng: Random, some: tuple[tuple[str, bytes], ...]) -> tuple[str, bytes]:
    name, data = rng.choice(some)
    if rng.random() < 0.0005:
        return "bomb.png", bomb(rng.choice((4_000, 8_192, 12_000)))
    if name.endswith("png") and rng.random() < 0.7:
        return name, lying_png(data, rng)
    if name.endswith("jpg") and rng.random() < 0.4:
        return name, lying_jpeg(data, rng)
    return name, mutated(data, rng, [other for _, other in seeds()])


def read(folder: Path, name: str, data: bytes) -> None:
    path = folder / name
    path.write_bytes(data)
    image = check_image(path, name, data)
    decode(path, name, image.orientation)


def read_photograph(folder: Path, name: str, data: bytes) -> None:
    """As a photograph of footage, from which a capture is made."""
    path = folder / name
    path.write_bytes(data)
    convert_photographs([path], folder, 32, lambda done, count: None)
