"""Memory that an anchor takes in training.

Counts what grows with the anchors: rows with their gradients and moments, statistics, and the activations of one
step in which every child is drawn. It is an upper bound.
"""

from __future__ import annotations

from typing import Final

from graings.config import SceneConfig
from graings.scene.encoding import direction_width, encoding_width

FLOAT: Final = 4

# Copies of a parameter: itself, its gradient, two moments and its average; two snapshots hold all but the gradient.
COPIES: Final = 5 + 2 * 4

# Means, quaternions, scales, opacity, colour, deformation and residual of one child in one view, and the buffers of
# the rasterizer.
CHILD_FLOATS: Final = 64

# Values and their gradients.
BOTH_WAYS: Final = 2


def bytes_per_anchor(config: SceneConfig, views: int) -> int:
    """Memory in bytes of one more anchor whose children are all drawn, with `views` per step."""
    k = config.children
    rows = 6 + config.feature_dim + 3 * k + 1
    statistics = 16 * k + 16
    # Uids are kept as they are; growth and pruning hold old and new rows at once.
    fixed = 8 * (1 + COPIES) + statistics * 4
    static = 3 + k + config.static_width
    deform = encoding_width(3, config.position_frequencies) + config.deform_width * config.deform_depth
    direction = (2 if config.reflection else 1) * direction_width(config.color_sh_degree)
    inputs, hidden = config.feature_dim + direction, 3 * config.head_width
    if config.residual_sh_degree > 0:  # a fourth head with its own inputs
        inputs += config.feature_dim + direction_width(config.residual_sh_degree)
        hidden += config.head_width
    heads = inputs + hidden + 8 * k + config.static_width
    networks = static + deform
    if config.single_mlp or config.time_conditioning == "concatenated":  # the hidden layers run once per time
        networks *= views
    activations = BOTH_WAYS * FLOAT * (k * (networks + views * CHILD_FLOATS) + views * heads)
    return FLOAT * rows * COPIES + fixed + activations
