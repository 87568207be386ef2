"""Seeds by name, so that leaving one part out does not change the numbers of another.

Knows nothing of what the numbers are used for.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from contextlib import contextmanager

import torch


def named_seed(seed: int, name: str) -> int:
    """The seed of the part `name` in a run of `seed`; 63 bits."""
    digest = hashlib.sha256(f"{seed}/{name}".encode()).digest()
    return int.from_bytes(digest[:8], "big") >> 1


@contextmanager
def global_stream(seed: int, name: str) -> Iterator[None]:
    """Torch's global stream, from which modules draw their weights, is that of `name` inside and as before after."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(named_seed(seed, name))
        yield
