"""Frequency encoding of positions and times.

Positions are constants to the networks that read them (Eq. 7), so that the kernel encodes them and nothing is kept
for a way back. Knows nothing of what is encoded.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from graings import kernel


def encoding_width(dimensions: int, octaves: int) -> int:
    """Length of the encoding of a `dimensions`-vector."""
    return dimensions * (1 + 2 * octaves)


def frequency_encoding(x: Float[Tensor, "*batch dim"], octaves: int) -> Float[Tensor, "*batch width"]:
    """(x, sin 2^0 x, ..., sin 2^(L-1) x, cos 2^0 x, ..., cos 2^(L-1) x) with L = `octaves`.

    The raw value comes along and the frequencies carry no factor pi (decision 13), so that over [0, 1] every
    octave but the last few is monotone and t = 0 and t = 1 never alias. Differentiable where `x` wants a gradient.
    """
    if octaves == 0:
        return x
    if x.requires_grad and torch.is_grad_enabled():
        return plain_frequency_encoding(x, octaves)
    encoded = x.new_empty(*x.shape[:-1], encoding_width(x.shape[-1], octaves))
    kernel.kernel().encode(x.detach().contiguous(), x.shape[-1], octaves, encoded, kernel.threads())
    return encoded


def plain_frequency_encoding(x: Float[Tensor, "*batch dim"], octaves: int) -> Float[Tensor, "*batch width"]:
    """The oracle of `frequency_encoding`, and what it is where `x` wants a gradient."""
    frequencies = 2.0 ** torch.arange(octaves, dtype=x.dtype, device=x.device)
    phases = (x.unsqueeze(-1) * frequencies).flatten(-2)
    return torch.cat([x, phases.sin(), phases.cos()], dim=-1)
