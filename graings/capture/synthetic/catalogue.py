"""The twelve scenes of the suite by name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from graings.capture.synthetic.scenes import (
    chrome,
    crossing,
    dimmer,
    flag,
    globe,
    rig,
    ring,
    room,
    still,
    sundial,
    walker,
    wheel,
)
from graings.capture.synthetic.world import World


@dataclass(frozen=True, slots=True)
class SuiteScene:
    """A scene: what it asks of a method, and how it is made."""

    name: str
    question: str
    build: Callable[[int], World]


SUITE: Final = (
    SuiteScene("walker", "articulated figure: bodies linked by joints, fast limbs", walker.build),
    SuiteScene("crossing", "a body crosses a textured room: large translation, filled background", crossing.build),
    SuiteScene("globe", "rotation of a fine texture", globe.build),
    SuiteScene("ring", "torus to sphere: change of topology", ring.build),
    SuiteScene("flag", "deformation of a thin sheet", flag.build),
    SuiteScene("sundial", "moving light: shadows and shading change, nothing moves", sundial.build),
    SuiteScene("chrome", "mirror ball: reflections and narrow highlights", chrome.build),
    SuiteScene("wheel", "thin structures: spokes, wires, hanging cabins", wheel.build),
    SuiteScene("room", "a room with one small mover: nine tenths are static", room.build),
    SuiteScene("dimmer", "exposure changes, nothing moves", dimmer.build),
    SuiteScene("rig", "12 fixed cameras, all instants each", rig.build),
    SuiteScene("still", "one instant", still.build),
)


def scene_named(name: str) -> SuiteScene:
    """The entry of a scene. Raises `ValueError` with the names there are."""
    for entry in SUITE:
        if entry.name == name:
            return entry
    raise ValueError(f"there is no scene {name!r}; there are {', '.join(entry.name for entry in SUITE)}")
