"""Frequency encoding of positions and times.

Knows nothing of what is encoded.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor


def encoding_width(dimensions: int, octaves: int) -> int:
    """Length of the encoding of a `dimensions`-vector."""
    return dimensions * (1 + 2 * octaves)


def frequency_encoding(x: Float[Tensor, "*batch dim"], octaves: int) -> Float[Tensor, "*batch width"]:
    """(x, sin 2^0 x, ..., sin 2^(L-1) x, cos 2^0 x, ..., cos 2^(L-1) x) with L = `octaves`.

    The raw value comes along and the frequencies carry no factor pi (decision 13), so that over [0, 1] every
    octave but the last few is monotone and t = 0 and t = 1 never alias.
    """
    if octaves == 0:
        return x
    frequencies = 2.0 ** torch.arange(octaves, dtype=x.dtype, device=x.device)
    phases = (x.unsqueeze(-1) * frequencies).flatten(-2)
    return torch.cat([x, phases.sin(), phases.cos()], dim=-1)
