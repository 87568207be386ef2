"""drop_unseen: after the last step, remove anchors that no training view shows.

What lies behind surfaces in all training views gets no gradient: it keeps the opacity with which it began, and appears
where a new view looks past the surface. Such anchors cost bytes and time, and quality in those views.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from graings.capture.capture import Frame
from graings.evaluation.evaluate import subset
from graings.render import contributions
from graings.report.events import Event, Unseen
from graings.scene.prepared import PreparedScene
from graings.scene.scene import Scene
from graings.training.trainer import Trainer
from graings.training.training_log import TrainingLog


def drop_unseen(trainer: Trainer, log: TrainingLog) -> tuple[Event, ...]:
    """Remove every anchor whose children each contribute less than `density.unseen_pixels` to each training view.

    A scene of which nothing is seen stays as it is. Where anchors go, the log's number of Gaussians becomes that of as
    many training views as a step has, chosen by the hash of their names. Returns what happened.
    """
    least = log.config.density.unseen_pixels
    if least == 0:
        return ()
    with log.clock.timed(trainer.phase(trainer.iteration).name):
        keep = largest_contributions(trainer.scene, log.capture.train) >= least
        removed = int((~keep).sum())
        if 0 < removed < len(keep):
            trainer.keep_anchors(keep)
            log.gaussians = drawn_in_any(trainer.scene, subset(log.capture.train, log.config.batch))
    return (Unseen(iteration=trainer.run_iteration, anchors=removed),) if 0 < removed < len(keep) else ()


@torch.no_grad()
def drawn_in_any(scene: Scene, frames: Sequence[Frame]) -> int:
    """How many children are drawn in any of these views."""
    return len(scene.compose_together([(frame.camera.center, frame.time) for frame in frames])[0].children)


def largest_contributions(scene: Scene, frames: Sequence[Frame]) -> Float[Tensor, " anchor"]:
    """Of each anchor the largest sum of blending weights, in px, that one of its children has in one of the views."""
    prepared = PreparedScene(scene)
    found = torch.zeros(scene.scaffold.count * scene.scaffold.slots)
    for frame in frames:
        with torch.no_grad():
            view = prepared.compose(frame.camera.center, frame.time)
        found[view.children] = torch.maximum(found[view.children], contributions(view, frame.camera))
    return found.view(scene.scaffold.count, -1).amax(1)
