"""The track loss: how far DeformNet is from the displacements of tracked points."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import torch
from jaxtyping import Float
from torch import Tensor

from graings.scene.scene import Scene
from graings.training.tracks.motion_tracks import MotionTracks

# In a schedule of 30 000, the iteration at which the loss has faded out: the images know better by then.
UNTIL: Final = 15_000


def track_loss(scene: Scene, tracks: MotionTracks, moments: Sequence[float]) -> Float[Tensor, ""]:
    """Mean absolute difference, in units of the extent, over the tracked points and those at rest at `moments`.

    Zero without DeformNet.
    """
    if scene.deformation is None:
        return torch.zeros(())
    places = scene.network_positions(torch.cat([tracks.points, tracks.rest]))
    offsets = scene.deformation(places, torch.tensor(moments, dtype=places.dtype).unsqueeze(-1))[..., :3]
    at_rest = torch.zeros(len(moments), len(tracks.rest), 3)
    wanted = torch.cat([tracks.displacements(moments), at_rest], dim=1) / scene.extent
    return (offsets.transpose(0, 1) - wanted).abs().mean()
