"""Normalisation: one change of units for a whole capture, in float64, before anything is learned.

Lengths: centred on what the cameras look at, scaled by a power of two to about 1. Times: mapped to [0, 1] over all
splits. Knows nothing of file formats.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from graings.camera.camera import Camera
from graings.camera.units import Units
from graings.capture.capture import ALL_SPLITS, Capture, Frame, PointCloud
from graings.capture.raw_capture import MAX_DISTANCE, RawCapture, RawFrame
from graings.errors import CaptureError

Array = NDArray[np.float64]

# Focal lengths and distances of the principal point beyond these, in picture sizes, are slips of the file.
SHORTEST, LONGEST, OFF_AXIS = 1e-3, 1e6, 1e3

# Time stamps closer than this share of the whole range are one instant.
SAME_INSTANT = 1e-6

# Mean squared sine between optical axes below which they count as parallel (about half a degree).
PARALLEL = 1e-4

# A vertical axis this close to a world axis (cos 10 degrees) is meant to be that axis.
NEARLY_AXIS = math.cos(math.radians(10.0))


def normalize(recording: RawCapture, *, root: Path, max_side: int | None, content_hash: str) -> Capture:
    """The capture in normalised units, its cameras reduced to `max_side` px."""
    notes = list(recording.notes)
    shots = [shot for split in ALL_SPLITS for shot in recording.splits.get(split, ())]
    for shot in shots:
        for field, size in (("camera position", np.abs(shot.camera.center).max()), ("time", abs(shot.time or 0.0))):
            if size > MAX_DISTANCE:
                raise CaptureError(
                    f"is {size:.3g}; nothing beyond {MAX_DISTANCE:g} is taken",
                    file=shot.image.name,
                    field=field,
                    remedy="Correct it in the file that lists the image.",
                )
        _check_lens(shot)
    cameras = [shot.camera for shot in recording.splits["train"]]
    center, scale, found = frame_of_reference(cameras, recording.positions)
    notes += found
    instants = _instants([shot.time for shot in shots if shot.time is not None])
    stamps = sorted(set(instants.values()))
    if not stamps:
        notes.append("no times: the scene is taken to be static")
    elif len(stamps) == 1:
        notes.append("all frames share one time: the scene is taken to be static")
    units = Units(
        center=(float(center[0]), float(center[1]), float(center[2])),
        scale=scale,
        time_start=stamps[0] if stamps else 0.0,
        time_span=stamps[-1] - stamps[0] if stamps else 0.0,
        up=vertical(cameras),
    )

    def frame(shot: RawFrame) -> Frame:
        source = shot.camera
        camera = Camera(
            units.camera(source.world_to_camera),
            source.fx,
            source.fy,
            source.cx,
            source.cy,
            source.width,
            source.height,
        )
        return Frame(
            name=shot.image.name,
            camera=_at_most(camera, max_side),
            time=0.0 if shot.time is None else units.time(instants[shot.time]),
            image_path=shot.image.path,
            source_size=(shot.image.width, shot.image.height),
            lens=shot.lens,
        )

    splits = {split: tuple(frame(shot) for shot in recording.splits.get(split, ())) for split in ALL_SPLITS}
    points = None
    if recording.positions is not None and recording.colors is not None:
        points = PointCloud(units.points(recording.positions), recording.colors)
    return Capture(
        root=root,
        kind=recording.kind,
        train=splits["train"],
        val=splits["val"],
        test=splits["test"],
        between=splits["between"],
        units=units,
        has_alpha=any(shot.image.has_alpha for shot in shots),
        points=points,
        notes=tuple(notes),
        content_hash=content_hash,
    )


def _check_lens(shot: RawFrame) -> None:
    """Raises `CaptureError` for a camera whose picture no rounding would survive."""
    camera = shot.camera
    for across, focal, middle, size in (
        ("x", camera.fx, camera.cx, camera.width),
        ("y", camera.fy, camera.cy, camera.height),
    ):
        if not SHORTEST <= focal / size <= LONGEST:
            problem = f"is {focal / size:.3g} picture sizes; from {SHORTEST:g} to {LONGEST:g} are taken"
            field = f"focal length f{across}"
        elif abs(middle) / size > OFF_AXIS:
            problem = f"is {middle / size:.3g} picture sizes; nothing beyond {OFF_AXIS:g} is taken"
            field = f"principal point c{across}"
        else:
            continue
        raise CaptureError(
            problem, file=shot.image.name, field=field, remedy="Correct it in the file that holds the camera."
        )


def frame_of_reference(cameras: Sequence[Camera], points: Array | None) -> tuple[Array, float, list[str]]:
    """Centre [3] and power-of-two scale of a capture, and what had to be assumed.

    Centre: median of `points` [M, 3], or the point nearest to all optical axes. Radius: 90th percentile of the
    distances of points or cameras from it, whichever is larger.
    """
    centers = np.stack([camera.center for camera in cameras])
    notes: list[str] = []
    if points is not None:
        center = np.median(points, axis=0)
        radius = float(np.percentile(np.linalg.norm(points - center, axis=1), 90))
    else:
        center, note = _look_at(cameras, centers)
        notes += note
        radius = 0.0
    radius = max(radius, float(np.percentile(np.linalg.norm(centers - center, axis=1), 90)))
    if radius < 1e-12:
        radius = 1.0
    # Nearest power of two to 1 / radius by exponent arithmetic: rounding a logarithm could break a tie
    # differently for a capture scaled by 2^k, which must come out with the same bits.
    mantissa, exponent = math.frexp(radius)
    return center, math.ldexp(1.0, int(mantissa < math.sqrt(0.5)) - exponent), notes


def vertical(cameras: Sequence[Camera]) -> tuple[float, float, float]:
    """The capture's up axis, unit length: perpendicular to all horizons where these agree, else the mean camera up."""
    mean = np.mean([-camera.world_to_camera[1, :3] for camera in cameras], axis=0)
    rights = np.stack([camera.world_to_camera[0, :3] for camera in cameras])
    values, vectors = np.linalg.eigh(rights.T @ rights / len(cameras))
    # Level cameras have right axes in one plane; a camera looking steeply down has an up axis far off the vertical,
    # so its horizon says more. One camera, or cameras rolled at will, leave only the mean.
    axis = vectors[:, 0] if values[0] < 0.05 * values[1] else mean
    if axis @ mean < 0:
        axis = -axis
    length = float(np.linalg.norm(axis))
    if length < 1e-6:
        return (0.0, 0.0, 1.0)
    axis = axis / length
    main = int(np.argmax(np.abs(axis)))
    if abs(axis[main]) > NEARLY_AXIS:
        axis = np.sign(axis[main]) * np.eye(3)[main]
    return (float(axis[0]), float(axis[1]), float(axis[2]))


def _look_at(cameras: Sequence[Camera], centers: Array) -> tuple[Array, list[str]]:
    axes = np.stack([camera.forward for camera in cameras])
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]  # distance from an axis, as a projection
    middle = np.median(centers, axis=0)
    if float(np.linalg.eigvalsh(across.mean(axis=0))[0]) > PARALLEL:
        right_hand = np.einsum("nij,nj->i", across, centers - middle) / len(cameras)
        center = middle + np.linalg.solve(across.mean(axis=0), right_hand)
        if np.median(np.einsum("ni,ni->n", axes, center - centers)) > 0:
            return center, []
        return middle, ["the cameras look outwards: the scene is centred on the cameras"]
    spread = float(np.percentile(np.linalg.norm(centers - middle, axis=1), 90))
    forward = axes.mean(axis=0)
    forward = forward / np.linalg.norm(forward)
    if spread < 1e-12:
        return middle + forward, [
            "no_scale: one camera position and no points, so nothing tells the size of the scene; "
            "its centre is taken one unit in front of the camera"
        ]
    return middle + 2.0 * spread * forward, [
        "no_parallax: all cameras look the same way and there are no points; "
        "the centre is taken in front of them at twice their spread"
    ]


def _instants(stamps: Sequence[float]) -> dict[float, float]:
    """Each time stamp and the instant it stands for: the first of those within `SAME_INSTANT` of the range."""
    ordered = sorted(set(stamps))
    instants: dict[float, float] = {}
    current = -math.inf
    for stamp in ordered:
        if stamp - current > SAME_INSTANT * (ordered[-1] - ordered[0]):
            current = stamp
        instants[stamp] = current
    return instants


def _at_most(camera: Camera, max_side: int | None) -> Camera:
    longest = max(camera.width, camera.height)
    if max_side is None or longest <= max_side:
        return camera
    return camera.resized(
        max(1, round(camera.width * max_side / longest)), max(1, round(camera.height * max_side / longest))
    )
