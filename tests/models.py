"""Tiny scenes for tests: a few anchors with random values, networks with weights as if trained."""

from __future__ import annotations

import torch

from graings.camera.sampling_rate import SamplingRate
from graings.config import SceneConfig
from graings.scene.scaffold import Scaffold
from graings.scene.scene import Scene

EYE = (0.0, -2.0, 0.5)


SAMPLING = SamplingRate(extent=1.0, reference=10.0, coarsest=10.0)  # about that of small test cameras


def tiny_scene(
    *, anchors: int = 20, seed: int = 0, temporal: bool = True, trained: bool = True, **config: object
) -> Scene:
    """A scene of `anchors` anchors in the unit ball; `trained` gives the layers that start at zero random weights."""
    settings = SceneConfig.model_validate(
        {"children": 3, "feature_dim": 8, "head_width": 8, "static_width": 8, "deform_width": 16, "deform_depth": 2}
        | config
    )
    torch.manual_seed(seed)
    scaffold = Scaffold(
        anchors=torch.randn(anchors, 3) * 0.3,
        log_scales=torch.full((anchors, 3), -2.5) + 0.1 * torch.randn(anchors, 3),
        features=torch.randn(anchors, settings.feature_dim),
        offsets=torch.randn(anchors, settings.children, 3) * 0.3,
        opacity_offsets=torch.zeros(anchors, settings.children) if settings.child_opacity_offsets else None,
    )
    scene = Scene(settings, scaffold, extent=1.0, sampling=SAMPLING, initial_opacity=0.3)
    if trained:
        with torch.no_grad():
            view_dependent = None if scene.residual is None else scene.residual.seeing
            for module in (scene.deformation, scene.residual, view_dependent, scene.single):
                if module is not None:
                    module.out.weight.normal_(std=0.1)
                    module.out.bias.normal_(std=0.1)
    scene.temporal = temporal
    return scene
