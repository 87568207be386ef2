"""SyntheticScene: a few ellipsoids that move, rotate, deform and change colour, and captures of them.

Everything is a formula of time, so tests know the exact position of each body. Captures are written in the D-NeRF
layout and read by the same reader as any other.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import OpenImageIO as oiio
from numpy.typing import NDArray

from graings.camera.camera import Camera
from graings.capture.capture import SPLITS

Array = NDArray[np.float64]

CAMERA_DISTANCE: Final = 4.0
FIELD_OF_VIEW: Final = 0.69  # horizontal, radians; both as in the D-NeRF scenes
SAMPLES: Final = 4  # per pixel and axis

# Bodies are placed on a ring around the origin and oscillate about these positions. Their size decreases with their
# number, so that they cannot touch.
RING: Final = 0.75
SIDE_SWING: Final = 0.12
LIFT: Final = 0.3
LARGEST: Final = 0.42
SQUASH: Final = 0.2  # relative change of the first semi-axis; the others change by half of it with the opposite sign
TURN: Final = 1.5  # radians from t = 0 to 1
TINT: Final = 0.06  # amplitude of the change of colour

# Lambertian shading under one fixed light, mostly ambient: colour depends on the surface normal, not on the view.
LIGHT: Final = np.array([0.4, -0.3, 0.866])
AMBIENT: Final = 0.75

GOLDEN_RATIO: Final = (math.sqrt(5.0) - 1.0) / 2.0


@dataclass(frozen=True, slots=True, eq=False)
class Body:
    """An ellipsoid with a two-coloured pattern."""

    home: Array  # [3] mean centre
    swing: Array  # [3] amplitudes along x, y, z
    semi_axes: Array  # [3] at rest
    axis: Array  # [3] unit axis of rotation
    colors: Array  # [2, 3] the two colours of the pattern
    phases: Array  # [6] of swing (3), squash, tint, pattern

    def center(self, time: float) -> Array:
        """Centre [3] at `time` in [0, 1]."""
        return self.home + self.swing * np.sin(2 * np.pi * time + self.phases[:3])

    def rotation(self, time: float) -> Array:
        """Body axes as columns, [3, 3]."""
        x, y, z = self.axis
        cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        angle = TURN * time
        return np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross

    def radii(self, time: float) -> Array:
        """Semi-axes [3] at `time`; each changes by its own factor."""
        amount = SQUASH * math.sin(2 * np.pi * time + self.phases[3])
        return self.semi_axes * (1 + amount * np.array([1.0, -0.5, -0.5]))

    def surface(self, points: Array, normals: Array, time: float) -> Array:
        """Colours [N, 3] of surface `points` [N, 3] on the unit sphere in body axes with world `normals` [N, 3]."""
        wave = np.sin(5.0 * points[:, 0] + self.phases[5]) * np.sin(5.0 * points[:, 1]) + 0.5 * np.sin(
            4.0 * points[:, 2]
        )
        mix = (0.5 + wave / 3.0)[:, None]
        tint = TINT * np.sin(2 * np.pi * time + self.phases[4] + np.array([0.0, 2.1, 4.2]))
        albedo = (1 - mix) * self.colors[0] + mix * self.colors[1] + tint
        light = AMBIENT + (1 - AMBIENT) * np.clip(normals @ LIGHT, 0.0, None)
        return np.clip(albedo * light[:, None], 0.0, 1.0)


@dataclass(frozen=True, slots=True, eq=False)
class SyntheticScene:
    """The bodies, in capture units: within about 1.2 of the origin, z up."""

    bodies: tuple[Body, ...]

    @staticmethod
    def random(seed: int = 0, bodies: int = 3) -> SyntheticScene:
        """A random scene of `bodies` bodies, determined by `seed`."""
        if bodies < 1:
            raise ValueError(f"bodies must be at least 1, got {bodies}")
        rng = np.random.default_rng(seed)
        spacing = 2 * RING * math.sin(math.pi / bodies) if bodies > 1 else 2 * RING
        side = min(SIDE_SWING, 0.09 * spacing)
        largest = min(LARGEST, (spacing - 2 * math.sqrt(2) * side) / (2 * (1 + SQUASH)))
        random_bodies = []
        for index in range(bodies):
            angle = 2 * math.pi * index / bodies + 0.3
            reach = RING if bodies > 1 else 0.0
            axis = rng.normal(size=3) + np.array([0.0, 0.0, 2.0])
            hue = index / bodies + rng.uniform(0, 0.15)
            random_bodies.append(
                Body(
                    home=np.array([reach * math.cos(angle), reach * math.sin(angle), rng.uniform(-0.15, 0.15)]),
                    swing=np.array([side, side, LIFT]),
                    semi_axes=largest * rng.uniform(0.75, 1.0, size=3),
                    axis=axis / np.linalg.norm(axis),
                    colors=np.stack([_hue(hue, 0.95), _hue(hue + 0.1, 0.5)]),
                    phases=rng.uniform(0, 2 * np.pi, size=6),
                )
            )
        return SyntheticScene(tuple(random_bodies))

    def centers(self, time: float) -> Array:
        """Exact centre of every body at `time`, [bodies, 3]."""
        return np.stack([body.center(time) for body in self.bodies])

    def image(self, camera: Camera, time: float) -> Array:
        """The image of `camera` (capture units): RGBA [H, W, 4] in [0, 1], straight alpha, ray-cast, anti-aliased."""
        width, height = camera.width * SAMPLES, camera.height * SAMPLES
        fine = camera.resized(width, height)
        depth = np.full((height, width), np.inf)
        color = np.zeros((height, width, 3))
        for body in self.bodies:
            _ray_cast(body, time, fine, depth, color)
        hit = np.isfinite(depth).reshape(camera.height, SAMPLES, camera.width, SAMPLES)
        sums = color.reshape(camera.height, SAMPLES, camera.width, SAMPLES, 3).sum(axis=(1, 3))
        count = hit.sum(axis=(1, 3))[..., None]
        return np.concatenate([sums / np.maximum(count, 1), count / SAMPLES**2], axis=2)


def write_synthetic(folder: Path, *, seed: int = 0, frames: int = 60, size: int = 128, bodies: int = 3) -> Path:
    """Write a capture of `frames` training images of `size` x `size` px into `folder`, which is returned.

    One moving camera with one image per time, as in D-NeRF. The val and test splits each have an eighth as many images,
    at other times and from other directions than the training images.
    """
    if frames < 1 or size < 1:
        raise ValueError(f"frames and size must be at least 1, got {frames} and {size}")
    scene = SyntheticScene.random(seed, bodies)
    held_out = max(2, frames // 8)
    times = {
        "train": [index / max(frames - 1, 1) for index in range(frames)],
        "val": [(index + 0.45) / held_out for index in range(held_out)],
        "test": [(index + 0.7) / held_out for index in range(held_out)],
    }
    for number, split in enumerate(SPLITS):
        (folder / split).mkdir(parents=True, exist_ok=True)
        entries = []
        for index, time in enumerate(times[split]):
            camera = _hemisphere(index, start=seed * GOLDEN_RATIO + number / 3, size=size)
            name = f"{split}/r_{index:03d}"
            _write_png(folder / f"{name}.png", scene.image(camera, time))
            pose = np.linalg.inv(camera.world_to_camera)
            pose[:3, 1:3] *= -1.0  # OpenCV axes to OpenGL's
            entries.append({"file_path": f"./{name}", "time": time, "transform_matrix": pose.tolist()})
        document = {"camera_angle_x": FIELD_OF_VIEW, "frames": entries}
        (folder / f"transforms_{split}.json").write_text(json.dumps(document, indent=1))
    return folder


def _hemisphere(index: int, *, start: float, size: int) -> Camera:
    # Golden-ratio steps spread any number of directions evenly and keep neighbours in time far apart.
    azimuth = 360.0 * (start + index * GOLDEN_RATIO)
    elevation = 10.0 + 50.0 * ((start + index * GOLDEN_RATIO**2 * math.sqrt(2.0)) % 1.0)
    return Camera.orbit(azimuth, elevation, CAMERA_DISTANCE, fov=FIELD_OF_VIEW, width=size, height=size)


def _ray_cast(body: Body, time: float, camera: Camera, depth: NDArray[np.float64], color: Array) -> None:
    """Render a body into `depth` [H, W] and `color` [H, W, 3] where it is nearest."""
    pose = camera.world_to_camera
    center, rotation, radii = body.center(time), body.rotation(time), body.radii(time)
    rows, columns = _bounding_box(pose[:3, :3] @ center + pose[:3, 3], float(radii.max()), camera)
    x = (np.arange(columns.start, columns.stop) + 0.5 - camera.cx) / camera.fx
    y = (np.arange(rows.start, rows.stop) + 0.5 - camera.cy) / camera.fy
    # In body axes divided by the radii the body is the unit sphere; a ray's parameter remains the camera depth.
    to_body = rotation.T / radii[:, None]
    origin = to_body @ (camera.center - center)
    steps = to_body @ pose[:3, :3].T
    rays = x[None, :, None] * steps[:, 0] + y[:, None, None] * steps[:, 1] + steps[:, 2]
    a = np.einsum("hwi,hwi->hw", rays, rays)
    b = rays @ origin
    inside = b * b - a * (origin @ origin - 1.0)
    near = np.where(inside > 0, (-b - np.sqrt(np.maximum(inside, 0.0))) / a, np.inf)
    first = near < depth[rows, columns]
    points = origin + near[first][:, None] * rays[first]
    normals = points @ to_body  # gradient of |to_body x|^2 / 2
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    depth[rows, columns][first] = near[first]
    color[rows, columns][first] = body.surface(points, normals, time)


def _bounding_box(center: Array, radius: float, camera: Camera) -> tuple[slice, slice]:
    """Rows and columns that contain the image of a sphere in front of the camera."""
    slices = []
    for along, focal, principal, size in (
        (center[1], camera.fy, camera.cy, camera.height),
        (center[0], camera.fx, camera.cx, camera.width),
    ):
        middle = math.atan2(along, center[2])
        half = math.asin(radius / math.hypot(along, center[2]))
        low, high = (principal + focal * math.tan(middle + side * half) for side in (-1, 1))
        slices.append(slice(min(max(math.floor(low), 0), size), min(max(math.ceil(high), 0), size)))
    return slices[0], slices[1]


def _hue(hue: float, value: float) -> Array:
    wheel = 0.5 + 0.5 * np.cos(2 * np.pi * (hue - np.array([0.0, 1 / 3, 2 / 3])))
    mixed: Array = 0.08 + value * (0.1 + 0.8 * wheel)
    return mixed


def _write_png(path: Path, rgba: Array) -> None:
    pixels = np.ascontiguousarray(np.round(rgba * 255.0).astype(np.uint8))
    output = oiio.ImageOutput.create(str(path))
    spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], 4, "uint8")
    spec["oiio:UnassociatedAlpha"] = 1  # colours have straight alpha and must be stored unchanged
    if output is None or not (output.open(str(path), spec) and output.write_image(pixels) and output.close()):
        raise OSError(f"cannot write {path}: {oiio.geterror() if output is None else output.geterror()}")
