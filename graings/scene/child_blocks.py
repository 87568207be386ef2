"""Arrays of children in the blocks in which the kernel reads them."""

from __future__ import annotations

from typing import NamedTuple

from jaxtyping import Float, Int32, Int64
from torch import Tensor
from torch.nn import functional

# Children side by side in one block.
BLOCK = 16


def in_blocks(rows: Float[Tensor, "child width"]) -> Float[Tensor, "block width 16"]:
    """`rows` in blocks of `BLOCK` children, transposed; the last one is filled with zeros."""
    padded = functional.pad(rows, (0, 0, 0, -len(rows) % BLOCK))
    return padded.view(len(padded) // BLOCK, BLOCK, rows.shape[1]).transpose(1, 2).contiguous()


class ActiveUnits(NamedTuple):
    """Hidden units in blocks of `BLOCK` children, without those that ReLU makes zero in a whole block.

    A third is left out, because children near each other share theirs; it adds exactly nothing to a sum.
    """

    values: Float[Tensor, "active 16"]
    begin: Int64[Tensor, " _"]  # of each block in `values`, and the end of the last
    units: Int32[Tensor, " active"]  # which hidden unit each row of `values` is

    @staticmethod
    def of(hidden: Float[Tensor, "child width"]) -> ActiveUnits:
        """Those of `hidden`."""
        blocks = in_blocks(hidden)
        active = (blocks != 0).any(2)
        begin = functional.pad(active.sum(1).cumsum(0), (1, 0))
        return ActiveUnits(blocks[active], begin, active.nonzero()[:, 1].int())
