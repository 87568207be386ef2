"""Registration: what a reconstruction says about the frames, and whether a capture can be made of it."""

from __future__ import annotations

import itertools
import math
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from graings.errors import CaptureError
from graings.footage.report import FootageCamera

if TYPE_CHECKING:
    import pycolmap

Array = NDArray[np.float64]

# Below this share of the frames, or this number, the rest of the clip would be missing.
MIN_SHARE: Final = 0.5
MIN_FRAMES: Final = 8

# Degrees between the rays of a point below which its depth is a guess.
MIN_PARALLAX: Final = 2.0

MIN_TRACK: Final = 3
MAX_POINTS_MEASURED: Final = 2_000
PARALLAX_REMEDY: Final = "Walk sideways around the subject while recording, so that near things move against far ones."


@dataclass(frozen=True, slots=True)
class Registration:
    """Facts of a reconstruction; angles in degrees. `camera` is that of most images, `cameras` their number."""

    names: tuple[str, ...]
    points: int
    reprojection_error: float
    track_length: float
    parallax: float
    path_over_depth: float
    camera: FootageCamera
    cameras: int

    def notes(self) -> tuple[str, ...]:
        """A note on frames of several sizes."""
        if self.cameras == 1:
            return ()
        return (f"the frames have {self.cameras} sizes, each with a camera of its own; the one shown is of most",)


def measure(model: pycolmap.Reconstruction) -> Registration:
    """What `model` holds, over its registered images in order of their names."""
    images = sorted((model.image(key) for key in model.reg_image_ids()), key=lambda image: image.name)
    centers = {image.image_id: np.asarray(image.projection_center()) for image in images}
    points = [point for point in model.points3D.values() if point.track.length() >= MIN_TRACK]
    step = max(1, len(points) // MAX_POINTS_MEASURED)
    angles, depths = [], []
    for point in points[::step]:
        rays = np.stack([centers[element.image_id] - point.xyz for element in point.track.elements])
        lengths = np.linalg.norm(rays, axis=1)
        cosines = (rays @ rays.T) / np.outer(lengths, lengths)
        angles.append(math.degrees(math.acos(np.clip(cosines.min(), -1, 1))))
        depths.append(float(np.median(lengths)))
    path = sum(float(np.linalg.norm(b - a)) for a, b in itertools.pairwise(centers.values()))
    used = Counter(image.camera_id for image in images)
    camera = model.camera(used.most_common(1)[0][0])
    return Registration(
        names=tuple(image.name for image in images),
        points=len(points),
        reprojection_error=float(model.compute_mean_reprojection_error()),
        track_length=float(model.compute_mean_track_length()),
        parallax=float(np.median(angles)) if angles else 0.0,
        path_over_depth=path / float(np.median(depths)) if depths else 0.0,
        camera=FootageCamera(
            width=camera.width,
            height=camera.height,
            focal=camera.focal_length,
            field_of_view=math.degrees(2 * math.atan(camera.width / 2 / camera.focal_length)),
            distortion=float(camera.params[-1]),
        ),
        cameras=len(used),
    )


def nothing_registered(taken: int, source: Path) -> CaptureError:
    """The error for frames that do not fit together at all."""
    remedy = "Record slowly, with overlap between frames and texture in view, or take more frames (--frames)."
    return CaptureError(f"none of {taken} frames could be registered", file=source, remedy=remedy)


def check_usable(found: Registration, taken: int, source: Path) -> None:
    """Raise `CaptureError` where no capture can be made of it, saying what is wrong and how to record instead."""
    count = len(found.names)
    registered = f"registered {count} of {taken} frames"
    if found.parallax < MIN_PARALLAX:
        problem = f"{registered}; the camera hardly moves: points are seen over {found.parallax:.1f} degrees"
        raise CaptureError(problem, file=source, remedy=PARALLAX_REMEDY)
    if count < max(MIN_FRAMES, MIN_SHARE * taken):
        remedy = "Record slowly with more overlap, take more frames (--frames), or cut the clip to one continuous shot."
        raise CaptureError(f"{registered}, too few for the clip", file=source, remedy=remedy)


def upright(model: pycolmap.Reconstruction) -> Array:
    """Rotation [3, 3] that turns the mean upward direction of the cameras to +z, the convention of nerfstudio."""
    ups = [-np.asarray(model.image(key).cam_from_world().rotation.matrix())[1] for key in model.reg_image_ids()]
    up = np.mean(ups, axis=0)
    if np.linalg.norm(up) < 1e-6:
        return np.eye(3)  # cameras in all directions have no common "up"
    z = up / np.linalg.norm(up)
    x = np.cross(np.eye(3)[np.argmin(np.abs(z))], z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z])
