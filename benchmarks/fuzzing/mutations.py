"""Mutations: valid bytes or JSON made hostile. Everything random comes from the `Random` that is passed in."""

from __future__ import annotations

import copy
import json
import re
from collections.abc import Callable, Sequence
from random import Random
from typing import Any

Mutation = Callable[[bytes, Random, Sequence[bytes]], bytes]

# Numbers that a reader may trust: counts, sizes and offsets at the ends of what their type holds.
EXTREMES = (0, 1, 2, 127, 128, 255, 256, 0x7FFF, 0x8000, 0xFFFF, 0x10000, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, -1, -2)
WIDE = (*EXTREMES, 1 << 32, 1 << 40, 1 << 62, (1 << 63) - 1, 1 << 63, (1 << 64) - 1)
NUMBERS = (
    *("0", "-0", "-1", "1e400", "-1e308", "1e308", "1e-320", "NaN", "-Infinity", "0x10", "1_0", "٣", "1e", "--1"),
    *("2147483648", "4294967295", "9223372036854775808", "18446744073709551615", "1" * 400, "9" * 5_000),
)
TEXTS = (
    *("", " ", ".", "..", "/", "../../etc/passwd", "/etc/passwd", "C:\\x", "a/" * 500, "\0", "a\0.png", "\ud800"),
    *("\udfff.png", "é" * 300, "x" * 5_000, "x" * 300_000, "\n", "%s%n", "{0}", "\u202e", "CON", "~", "*"),
)
DEPTHS = (50, 300, 3_000, 100_000)


def mutated(data: bytes, rng: Random, others: Sequence[bytes]) -> bytes:
    """`data` after one to four mutations of bytes; `others` are further seeds to splice with."""
    for _ in range(rng.choice((1, 1, 1, 2, 3, 4))):
        data = rng.choice(MUTATIONS)(data, rng, others)
    return data


def flipped(data: bytes, rng: Random, others: Sequence[bytes]) -> bytes:
    changed = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 8, 64))):
        if changed:
            changed[rng.randrange(len(changed))] ^= 1 << rng.randrange(8)
    return bytes(changed)


def overwritten(data: bytes, rng: Random, others: Sequence[bytes]) -> bytes:
    """An integer of 1 to 8 bytes at an extreme, more often near the start, where headers are."""
    size = rng.choice((1, 2, 4, 8))
    end = len(data) if rng.random() < 0.5 else min(len(data), 128)
    place = rng.randrange(max(1, end - size + 1))
    value = rng.choice(WIDE) % (1 << (8 * size))
    return data[:place] + value.to_bytes(size, rng.choice(("little", "big"))) + data[place + size :]


def truncated(data: bytes, rng: Random, others: Sequence[bytes]) -> bytes:
    return data[: rng.randrange(len(data) + 1)]


def removed(data: bytes, rng: Random, others: Sequence[bytes]) -> bytes:
    start, size = rng.randrange(len(data) + 1), rng.choice((1, 2, 4, 16, 200))
    return data[:start] + data[start + size :]


def repeated(data: bytes, rng: Random, others: Sequence[bytes]) -> bytes:
    start, size = rng.randrange(len(data) + 1), rng.choice((1, 4, 16, 200))
    return data[:start] + data[start : start + size] * rng.choice((2, 3, 50)) + data[start + size :]


def inserted(data: bytes, rng: Random, others: Sequence[bytes]) -> bytes:
    place = rng.randrange(len(data) + 1)
    return data[:place] + rng.choice((rng.randbytes(8), b"\0" * 64, b"\xff" * 64)) + data[place:]


def spliced(data: bytes, rng: Random, others: Sequence[bytes]) -> bytes:
    other = rng.choice(others)
    return data[: rng.randrange(len(data) + 1)] + other[rng.randrange(len(other) + 1) :]


def renumbered(data: bytes, rng: Random, others: Sequence[bytes]) -> bytes:
    """A number that is written in text, replaced."""
    found = list(re.finditer(rb"-?\d+(\.\d+)?", data[:100_000]))
    if not found:
        return flipped(data, rng, others)
    place = rng.choice(found)
    return data[: place.start()] + rng.choice(NUMBERS).encode() + data[place.end() :]


MUTATIONS: tuple[Mutation, ...] = (
    *(flipped, flipped, overwritten, overwritten, truncated, removed, repeated, inserted, spliced, renumbered),
)


def hostile_value(rng: Random) -> Any:
    """A JSON value that does not belong where it will stand."""
    kind = rng.randrange(5)
    if kind == 0:
        return rng.choice(TEXTS)
    if kind == 1:
        return rng.choice((0, -1, 1e308, -1e308, 1e-320, 1e16, 2**31, 2**63, 2**64, 10**400, -(10**400), float("nan")))
    if kind == 2:
        return rng.choice((None, True, False, [], {}, [[]], [None], {"": None}, [0] * 5_000))
    return float("inf") if kind == 3 else rng.uniform(-1e3, 1e3)


def mutated_json(document: Any, rng: Random) -> bytes:
    """The document with some of its values, keys or lengths changed, as text that is mostly still JSON."""
    document = copy.deepcopy(document)
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        _change(document, rng)
    text = json.dumps(document)
    kind = rng.random()
    if kind < 0.05:
        depth = rng.choice(DEPTHS)
        opening, closing = rng.choice((("[", "]"), ('{"a":', "}")))
        text = opening * depth + text + closing * depth
    elif kind < 0.08:
        text = re.sub(r'"[^"]+"', lambda found: rng.choice((found[0], '"\\ud800"', '"\\u0000"')), text)
    elif kind < 0.12:
        return text.encode(rng.choice(("utf-16", "utf-32", "utf-8-sig", "utf-16-le", "utf-32-be")))
    return text.encode("utf-8", "surrogatepass")


def _change(document: Any, rng: Random) -> None:
    """Change one place below `document`, all places being about equally likely."""
    places = list(_places(document))
    if not places:
        return
    parent, key = rng.choice(places)
    action = rng.randrange(6)
    if action <= 2:
        parent[key] = hostile_value(rng)
    elif action == 3:
        del parent[key]
    elif action == 4:
        other, source = rng.choice(places)
        if isinstance(other, dict) and source not in other:
            return
        if isinstance(other, list) and source >= len(other):
            return
        parent[key] = copy.deepcopy(other[source])
    elif isinstance(parent, list):
        parent.extend([parent[key]] * rng.choice((1, 3, 200)))
    else:
        parent[rng.choice(TEXTS)] = parent.pop(key)


def _places(value: Any) -> Any:
    for key, child in value.items() if isinstance(value, dict) else enumerate(value):
        yield value, key
        if isinstance(child, dict | list):
            yield from _places(child)
