"""Budget: how many anchors fit into a given memory."""

from __future__ import annotations

from typing import Final

from graings.config import SceneConfig, TrainConfig
from graings.scene.memory import bytes_per_anchor

MEGABYTE: Final = 1_000_000


def most_anchors(config: TrainConfig) -> int:
    """Anchors that growth may reach: `density.max_anchors`, or what memory holds if that is less or there is none."""
    affordable = affordable_anchors(config.scene, config.batch, config.density.memory_mb)
    return affordable if config.density.max_anchors is None else min(config.density.max_anchors, affordable)


def affordable_anchors(config: SceneConfig, views: int, memory_mb: int) -> int:
    """Anchors that fit into `memory_mb`; at least 16."""
    return max(16, memory_mb * MEGABYTE // bytes_per_anchor(config, views))
