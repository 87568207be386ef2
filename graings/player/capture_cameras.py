"""capture_cameras: what a player needs to know of a model's capture; it takes no time to gather."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

from graings.camera.camera import View
from graings.camera.viewpoint import orbit_view
from graings.export.harmonics_fit import spread
from graings.player.scene import CameraFacts, CaptureCameras, UnitsFacts
from graings.storage.model import Model

MOST: Final = {"train": 60, "val": 20}  # cameras of each split


def capture_cameras(model: Model) -> CaptureCameras:
    """Units, background and cameras of the capture, and the view that a player begins with."""
    units = model.units
    start = orbit_view(model.views["train"], units)
    return CaptureCameras(
        units=UnitsFacts(
            center=units.center,
            scale=units.scale,
            up=units.up,
            time_start=units.time_start,
            time_span=units.time_span,
        ),
        background=model.background,
        start=_facts(View("start", start, 0.0)),
        cameras=tuple(_cameras(model)),
    )


def _cameras(model: Model) -> Iterator[CameraFacts]:
    for split, most in MOST.items():
        views = model.views.get(split, ())
        for index in spread(len(views), most):
            yield _facts(View(f"{split}:{index}", views[index].camera, views[index].time))


def _facts(view: View) -> CameraFacts:
    camera = view.camera
    return CameraFacts(
        name=view.name,
        time=view.time,
        world_to_camera=tuple(tuple(map(float, row)) for row in camera.world_to_camera[:3]),
        intrinsics=(camera.fx, camera.fy, camera.cx, camera.cy),
        size=(camera.width, camera.height),
    )
