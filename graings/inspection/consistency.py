"""Consistency of pictures and poses: whether matched features lie on rays that meet, and by which other axes they do.

A capture whose poses have other axes than its format says still loads. Matches of SIFT features between neighbouring
images tell: with the right poses the rays of most of them meet in front of both cameras. Where few do, the same test is
made with each of the mistakes that people make, and the one that explains the matches is named.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import permutations, product
from typing import Final

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from graings.camera.camera import Camera
from graings.camera.units import Units
from graings.capture.capture import Frame
from graings.capture.images import ImageStore
from graings.colmap import pycolmap_remedy
from graings.document import Document
from graings.matching.features import MAX_SIFT_SIDE, Features, extract, matches, neighbours, reduced
from graings.matching.rays import ray_intersections

Array = NDArray[np.float64]

IMAGES: Final = 16  # spread over the clip
STEPS: Final = (1, 2, 3)  # images so many places apart in the capture's order are matched, beside neighbouring cameras
PER_PAIR: Final = 40  # matches that are tested, so that one pair does not outweigh the others

# Fewer matches say nothing. A share of this much or more is that of right poses even where half of the scene moves.
MIN_MATCHES: Final = 40
GOOD: Final = 0.5
# Another convention is named if it explains this share of the matches, and this many times as many as the poses do.
EXPLAINS: Final = 0.4
TIMES_BETTER: Final = 1.4


class Consistency(Document):
    """How many matches of features the poses explain."""

    images: int = Field(ge=0, description="Images whose features were matched.")
    matches: int = Field(ge=0, description="Matches that were tested.")
    share: float | None = Field(
        ge=0, le=1, description="Share whose rays meet in front of both cameras; null with too few matches."
    )
    other: str | None = Field(None, description="The other convention that explains the matches; null without one.")
    other_share: float | None = Field(None, ge=0, le=1, description="Share that it explains.")
    reason: str | None = Field(None, description="Why nothing could be tested; null where it was.")


@dataclass(frozen=True, slots=True, eq=False)
class Convention:
    """A mistake in writing poses: how they are turned back into right ones, and its name."""

    name: str
    axes: Array  # [3, 3], signed permutation from the camera's axes as read to the right ones
    inverted: bool = False  # the matrices are the inverse of what the format asks for
    positions: Array | None = None  # [3, 3], signed permutation of the positions alone

    def applied(self, camera: Camera, axes_as_read: Array) -> Camera:
        """`camera` if the poses had been written by this convention. `axes_as_read`: the reader's change of axes."""
        pose = camera.world_to_camera.copy()
        if self.inverted:
            # As read, `pose` is axes_as_read @ inverse(matrix); it should have been axes_as_read @ matrix.
            change = np.eye(4)
            change[:3, :3] = axes_as_read
            pose = change @ np.linalg.inv(change.T @ pose)
        if self.positions is not None:
            pose[:3, 3] = -pose[:3, :3] @ self.positions @ (-pose[:3, :3].T @ pose[:3, 3])
        if np.linalg.det(self.axes) < 0:  # of a mirrored world, whose reflection makes the rotation proper again
            mirror = np.diag([1.0, 1.0, -1.0])
            center = mirror @ (-pose[:3, :3].T @ pose[:3, 3])
            pose[:3, :3] = self.axes @ pose[:3, :3] @ mirror
            pose[:3, 3] = -pose[:3, :3] @ center
        else:
            pose[:3] = self.axes @ pose[:3]
        return _with_pose(camera, pose)


def _with_pose(camera: Camera, pose: Array) -> Camera:
    return Camera(pose, camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height)


def consistency(frames: Sequence[Frame], images: ImageStore, units: Units, *, opengl: bool) -> Consistency:
    """Test the poses of `frames`, in the capture's order; `opengl` says that its format has OpenGL's camera axes.

    `units` are those of the capture: a mistake is one of the poses as its files have them.

    Masked pixels are not used. Raises `CaptureError` where an image cannot be read.
    """
    count = min(IMAGES, len(frames))
    chosen = [
        reduced(frames[index], MAX_SIFT_SIDE)
        for index in np.unique(np.linspace(0, len(frames) - 1, count).round().astype(int))
    ]
    try:
        features = extract(chosen, images)
    except ImportError:
        return Consistency(images=0, matches=0, share=None, reason=f"pycolmap is not installed ({pycolmap_remedy()})")
    cameras = [frame.camera for frame in chosen]
    pairs = set(neighbours(cameras, [frame.time for frame in chosen]))
    pairs |= {(one, one + step) for step in STEPS for one in range(len(chosen) - step)}
    found = [matched for one, other in sorted(pairs) if (matched := _Pair.of(one, other, features)) is not None]
    total = sum(len(pair.one) for pair in found)
    if total < MIN_MATCHES:
        reason = f"only {total} features match between images: too little texture, or too far apart"
        return Consistency(images=len(chosen), matches=total, share=None, reason=reason)
    share = _share(cameras, found)
    if share >= GOOD:
        return Consistency(images=len(chosen), matches=total, share=share)
    as_read = np.diag([1.0, -1.0, -1.0]) if opengl else np.eye(3)
    raw = [_with_pose(camera, units.camera_back(camera)) for camera in cameras]
    best, most = None, max(EXPLAINS, TIMES_BETTER * share)
    for convention in _conventions(opengl=opengl):
        explained = _share([convention.applied(camera, as_read) for camera in raw], found)
        if explained > most:
            best, most = convention, explained
    return Consistency(
        images=len(chosen),
        matches=total,
        share=share,
        other=None if best is None else best.name,
        other_share=None if best is None else most,
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Pair:
    """Matched pixels [m, 2] of two images by index."""

    first: int
    second: int
    one: Array
    other: Array

    @staticmethod
    def of(first: int, second: int, features: Sequence[Features]) -> _Pair | None:
        a, b = matches(features[first].descriptors, features[second].descriptors)
        if len(a) == 0:
            return None
        kept = np.unique(np.linspace(0, len(a) - 1, min(PER_PAIR, len(a))).round().astype(int))
        return _Pair(first, second, features[first].pixels[a[kept]], features[second].pixels[b[kept]])


def _share(cameras: Sequence[Camera], pairs: Sequence[_Pair]) -> float:
    """Share of the matches whose rays meet."""
    met = sum(
        len(ray_intersections(cameras[pair.first], cameras[pair.second], pair.one, pair.other)[0]) for pair in pairs
    )
    return met / sum(len(pair.one) for pair in pairs)


def _conventions(*, opengl: bool) -> Iterator[Convention]:
    """The mistakes, the commonest first: among equally good explanations the first is named."""
    flip, turns = np.diag([1.0, -1.0, -1.0]), {90: (0.0, 1.0), 180: (-1.0, 0.0), 270: (0.0, -1.0)}
    has, asked = ("OpenCV's (y down, z forward)", "OpenGL's (y up, z back)")
    if not opengl:
        has, asked = asked, has
    yield Convention(f"the camera axes are {has} instead of {asked}", flip)
    direction = "world-to-camera instead of camera-to-world" if opengl else "camera-to-world instead of world-to-camera"
    yield Convention(f"the matrices are {direction}", np.eye(3), inverted=True)
    yield Convention(f"the matrices are {direction}, and the camera axes {has} instead of {asked}", flip, inverted=True)
    for degrees, (cosine, sine) in turns.items():
        turn = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
        yield Convention(f"the pictures are turned by {degrees} degrees against the poses", turn)
    yield Convention(
        "the pictures are mirrored against the poses, or the world is left-handed", np.diag([-1.0, 1.0, 1.0])
    )
    for axes in _signed_permutations():
        if not np.array_equal(axes, np.eye(3)):
            yield Convention(f"the camera axes are ({_named(axes)}) instead of (x, y, z)", axes)
    for axes in _signed_permutations():
        if not np.array_equal(axes, np.eye(3)):
            name = f"the positions have the axes ({_named(axes)}) instead of those of the rotations"
            yield Convention(name, np.eye(3), positions=axes)


def _signed_permutations() -> Iterator[Array]:
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            axes = np.zeros((3, 3))
            axes[range(3), order] = signs
            yield axes


def _named(axes: Array) -> str:
    """A signed permutation in words, such as "x, z, -y"."""
    names = []
    for row in axes:
        column = int(np.abs(row).argmax())
        names.append(("-" if row[column] < 0 else "") + "xyz"[column])
    return ", ".join(names)
