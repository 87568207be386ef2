"""Whether an object is missing from one render: a whole block of it has another colour than the image."""

from __future__ import annotations

from typing import Final

from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

# The longer image side in cells. An object is missing where a block of BLOCK x BLOCK cells all differ in mean colour by
# more than COLOR_DIFFERENCE; silhouettes and limbs that are slightly misplaced are thinner.
CELLS: Final = 50
BLOCK: Final = 3
COLOR_DIFFERENCE: Final = 0.3


def has_missing_object(difference: Float[Tensor, "height width 3"]) -> bool:
    """Whether a block of the `difference` of a render and its image, both in [0, 1], is large."""
    height, width, _ = difference.shape
    cell = max(1, max(height, width) // CELLS)
    channels = difference.permute(2, 0, 1).unsqueeze(0)
    differs = functional.avg_pool2d(channels, min(cell, height, width)).abs().amax(1, keepdim=True) > COLOR_DIFFERENCE
    if min(differs.shape[-2:]) < BLOCK:
        return False
    return bool((functional.avg_pool2d(differs.float(), BLOCK, stride=1) > 1 - 1e-6).any())
