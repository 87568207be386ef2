"""Named random streams: each user of random numbers has its own, so that leaving one out does not change the others."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor


def stream_seed(seed: int, name: str) -> int:
    """The 63-bit seed of the stream `name` in a run with `seed`."""
    digest = hashlib.sha256(f"{seed}/{name}".encode()).digest()
    return int.from_bytes(digest[:8], "big") >> 1


@contextmanager
def torch_stream(seed: int, name: str) -> Iterator[None]:
    """Seeds torch's global generator, which initialises modules, with the stream `name`; restores it afterwards."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(stream_seed(seed, name))
        yield


class RandomStreams:
    """Generators by name, created on first use, whose states are saved and restored together."""

    def __init__(self, seed: int) -> None:
        self.seed = seed
        self._generators: dict[str, torch.Generator] = {}

    def __getitem__(self, name: str) -> torch.Generator:
        if name not in self._generators:
            generator = torch.Generator()
            generator.manual_seed(stream_seed(self.seed, name))
            self._generators[name] = generator
        return self._generators[name]

    def state(self) -> dict[str, Tensor]:
        """State of every stream used so far."""
        return {name: generator.get_state() for name, generator in sorted(self._generators.items())}

    def load(self, state: dict[str, Tensor]) -> None:
        """Restore the generators to `state`; a stream that was not used then starts from its beginning."""
        for name, generator in self._generators.items():
            if name not in state:
                generator.manual_seed(stream_seed(self.seed, name))
        for name, tensor in state.items():
            self[name].set_state(tensor)
