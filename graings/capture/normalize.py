"""Normalisation: one change of units for a whole capture, in float64, before training.

Lengths: centred on the point at which the cameras look, scaled by a power of two to about 1. Times: mapped to [0, 1]
over all splits.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from graings.camera.camera import Camera
from graings.camera.units import Units
from graings.capture.capture import ALL_SPLITS, Capture, Frame, Kind, PointCloud
from graings.capture.raw_capture import MAX_MAGNITUDE, RawCapture, RawFrame
from graings.errors import CaptureError, printable

Array = NDArray[np.float64]

# Focal lengths and principal points outside these bounds, in image sizes, are errors of the file.
MIN_FOCAL_LENGTH, MAX_FOCAL_LENGTH, MAX_PRINCIPAL_POINT = 1e-3, 1e6, 1e3

# Where each kind of capture gives its times, for a message.
TIMES: dict[Kind, str] = {
    "transforms": "the key `time` of each frame",
    "colmap": 'times.json beside images/, {"NAME": time}',
    "nerfies": "the key `time_id` of each entry of metadata.json",
    "llff": "a folder of frames for each camera",
}

# Times that differ by no more than this fraction of the whole range are one instant.
TIME_TOLERANCE = 1e-6

# Times in any unit since any day are used. Beyond this, differences and quotients of times could overflow.
MAX_TIME = 1e100

# Times must be stored in steps of at most this fraction of the whole range: a tenth of a frame of a clip of 1000.
TIME_RESOLUTION = 1e-4

# Mean squared sine between optical axes below which they count as parallel (about half a degree).
PARALLEL_SINE_SQUARED = 1e-4

# An up axis within 10 degrees of a world axis is replaced by it: captures are almost always levelled to their world.
SNAP_COSINE = math.cos(math.radians(10.0))

# The right axes of the cameras lie in a plane if their second moment across it is below this fraction of the next one.
PLANAR_RATIO = 0.05

# Directions that differ by less are parallel: rounding of their components.
PARALLEL = 1e-6

# Distances below this, in the capture's unit, count as zero.
MIN_DISTANCE = 1e-12


def normalize(raw: RawCapture, *, root: Path, max_side: int | None, content_hash: str) -> Capture:
    """The capture in normalised units, with cameras downscaled to at most `max_side` px.

    Raises `CaptureError` naming the image whose camera or time has an impossible value.
    """
    notes = list(raw.notes)
    raw_frames = [raw_frame for split in ALL_SPLITS for raw_frame in raw.splits.get(split, ())]
    for raw_frame in raw_frames:
        _check_magnitudes(raw_frame)
        _check_intrinsics(raw_frame)
    _check_times(raw_frames)
    cameras = [raw_frame.camera for raw_frame in raw.splits["train"]]
    center, scale, assumptions = center_and_scale(cameras, raw.positions)
    notes += assumptions
    instants = _merged_times([raw_frame.time for raw_frame in raw_frames if raw_frame.time is not None])
    times = sorted(set(instants.values()))
    if not times:
        notes.append(
            "no times: the scene is assumed to be static; if it moves, give every image its time "
            f"({TIMES[raw.kind]}), or set capture.times_from_names=true to take it from the number in its file name"
        )
    elif len(times) == 1:
        notes.append("all frames share one time: the scene is assumed to be static")
    units = Units(
        center=(float(center[0]), float(center[1]), float(center[2])),
        scale=scale,
        time_start=times[0] if times else 0.0,
        time_span=times[-1] - times[0] if times else 0.0,
        up=up_axis(cameras),
    )

    def normalized(raw_frame: RawFrame) -> Frame:
        source = raw_frame.camera
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
            name=raw_frame.image.name,
            camera=_downscaled(camera, max_side),
            time=0.0 if raw_frame.time is None else units.time(instants[raw_frame.time]),
            image_path=raw_frame.image.path,
            source_size=(raw_frame.image.width, raw_frame.image.height),
            lens=raw_frame.lens,
            orientation=raw_frame.image.orientation if raw_frame.image.upright else 1,
            mask_path=None if raw_frame.mask is None else raw_frame.mask.path,
        )

    splits = {split: tuple(normalized(raw_frame) for raw_frame in raw.splits.get(split, ())) for split in ALL_SPLITS}
    points = None
    if raw.positions is not None and raw.colors is not None:
        points = PointCloud(units.points(raw.positions), raw.colors)
    return Capture(
        root=root,
        kind=raw.kind,
        train=splits["train"],
        val=splits["val"],
        test=splits["test"],
        between=splits["between"],
        units=units,
        has_alpha=any(raw_frame.image.has_alpha for raw_frame in raw_frames),
        points=points,
        notes=tuple(map(printable, notes)),
        content_hash=content_hash,
    )


def _check_magnitudes(raw_frame: RawFrame) -> None:
    """Raises `CaptureError` for a camera or a time beyond all bounds."""
    position, time = float(np.abs(raw_frame.camera.center).max()), raw_frame.time or 0.0
    for field, value, limit in (("camera position", position, MAX_MAGNITUDE), ("time", time, MAX_TIME)):
        if not abs(value) <= limit:  # true for NaN as well
            raise CaptureError(
                f"is {value:.3g}, beyond the limit of {limit:g}",
                file=raw_frame.image.name,
                field=field,
                remedy="Correct it in the file that lists the image.",
            )


def _check_times(raw_frames: Sequence[RawFrame]) -> None:
    """Raises `CaptureError` naming an image for times so large that float64 does not resolve their differences."""
    timed = [(raw_frame.time, raw_frame.image.name) for raw_frame in raw_frames if raw_frame.time is not None]
    if not timed:
        return
    times = [time for time, _ in timed]
    largest, name = max(timed, key=lambda pair: abs(pair[0]))
    step, span = float(np.spacing(abs(largest))), max(times) - min(times)
    if span > 0 and step > TIME_RESOLUTION * span:
        raise CaptureError(
            f"is {largest:.17g}; numbers of this size are stored in steps of {step:.3g}, too coarse for times that "
            f"differ by {span:.3g} in all",
            file=name,
            field="time",
            remedy="Subtract the first time from all times.",
        )


def _check_intrinsics(raw_frame: RawFrame) -> None:
    """Raises `CaptureError` for intrinsics with which projections would be dominated by rounding errors."""
    camera = raw_frame.camera
    for axis, focal, principal, size in (
        ("x", camera.fx, camera.cx, camera.width),
        ("y", camera.fy, camera.cy, camera.height),
    ):
        if not MIN_FOCAL_LENGTH <= focal / size <= MAX_FOCAL_LENGTH:
            limits = f"outside {MIN_FOCAL_LENGTH:g} to {MAX_FOCAL_LENGTH:g}"
            problem, field = f"is {focal / size:.3g} image sizes, {limits}", f"focal length f{axis}"
        elif abs(principal) / size > MAX_PRINCIPAL_POINT:
            limits = f"beyond the limit of {MAX_PRINCIPAL_POINT:g}"
            problem, field = f"is {principal / size:.3g} image sizes, {limits}", f"principal point c{axis}"
        else:
            continue
        raise CaptureError(
            problem, file=raw_frame.image.name, field=field, remedy="Correct it in the file that lists the camera."
        )


def center_and_scale(cameras: Sequence[Camera], points: Array | None) -> tuple[Array, float, list[str]]:
    """Centre [3] and power-of-two scale of a capture, and notes on assumptions.

    Centre: median of `points` [M, 3], or the point nearest to all optical axes. Radius: 90th percentile of the
    distances of points or cameras from it, whichever is larger.
    """
    centers = np.stack([camera.center for camera in cameras])
    notes: list[str] = []
    if points is not None:
        center = np.median(points, axis=0)
        radius = float(np.percentile(np.linalg.norm(points - center, axis=1), 90))
    else:
        center, assumptions = _point_of_interest(cameras, centers)
        notes += assumptions
        radius = 0.0
    radius = max(radius, float(np.percentile(np.linalg.norm(centers - center, axis=1), 90)))
    if radius < MIN_DISTANCE:
        radius = 1.0
    # Nearest power of two to 1 / radius by exponent arithmetic: a rounded logarithm could break a tie differently for
    # the same capture scaled by 2^k, whose normalised numbers must have the same bits.
    mantissa, exponent = math.frexp(radius)
    return center, math.ldexp(1.0, int(mantissa < math.sqrt(0.5)) - exponent), notes


def up_axis(cameras: Sequence[Camera]) -> tuple[float, float, float]:
    """Unit up axis of the capture: normal to the right axes of the cameras if these are coplanar, else the mean up."""
    mean = np.mean([-camera.world_to_camera[1, :3] for camera in cameras], axis=0)
    rights = np.stack([camera.world_to_camera[0, :3] for camera in cameras])
    values, vectors = np.linalg.eigh(rights.T @ rights / len(cameras))
    # Right axes of level cameras are horizontal at any elevation, whereas the up axis of a camera that looks down is
    # far from vertical. With parallel right axes, as of one camera, or with cameras rolled arbitrarily, only the mean
    # is defined.
    parallel = values[1] < PARALLEL * values[2]
    axis = vectors[:, 0] if values[0] < PLANAR_RATIO * values[1] and not parallel else mean
    if axis @ mean < 0:
        axis = -axis
    length = float(np.linalg.norm(axis))
    if length < 1e-6:
        return (0.0, 0.0, 1.0)
    axis = axis / length
    nearest = int(np.argmax(np.abs(axis)))
    if abs(axis[nearest]) > SNAP_COSINE:
        axis = np.sign(axis[nearest]) * np.eye(3)[nearest]
    return (float(axis[0]), float(axis[1]), float(axis[2]))


def _point_of_interest(cameras: Sequence[Camera], centers: Array) -> tuple[Array, list[str]]:
    """The point [3] with the least squared distances from all optical axes, and notes on assumptions."""
    axes = np.stack([camera.forward for camera in cameras])
    projections = np.eye(3) - axes[:, :, None] * axes[:, None, :]  # onto the planes perpendicular to each axis
    middle = np.median(centers, axis=0)
    if float(np.linalg.eigvalsh(projections.mean(axis=0))[0]) > PARALLEL_SINE_SQUARED:
        right_hand_side = np.einsum("nij,nj->i", projections, centers - middle) / len(cameras)
        center = middle + np.linalg.solve(projections.mean(axis=0), right_hand_side)
        if np.median(np.einsum("ni,ni->n", axes, center - centers)) > 0:
            return center, []
        return middle, ["the cameras look outwards: the scene is centred on the cameras"]
    spread = float(np.percentile(np.linalg.norm(centers - middle, axis=1), 90))
    forward = axes.mean(axis=0)
    length = float(np.linalg.norm(forward))
    if length < PARALLEL:
        return middle, []  # cameras on one line that look at each other
    forward = forward / length
    if spread < MIN_DISTANCE:
        return middle + forward, [
            "no_scale: one camera position and no points, so the size of the scene is unknown; "
            "its centre is assumed one unit in front of the camera"
        ]
    return middle + 2.0 * spread * forward, [
        "no_parallax: all cameras look in the same direction and there are no points; "
        "the centre is assumed in front of them at twice their spread"
    ]


def _merged_times(times: Sequence[float]) -> dict[float, float]:
    """Each time and the instant to which it is merged: the first of the times within `TIME_TOLERANCE` of the range."""
    ordered = sorted(set(times))
    instants: dict[float, float] = {}
    current = -math.inf
    for time in ordered:
        if time - current > TIME_TOLERANCE * (ordered[-1] - ordered[0]):
            current = time
        instants[time] = current
    return instants


def _downscaled(camera: Camera, max_side: int | None) -> Camera:
    longest = max(camera.width, camera.height)
    if max_side is None or longest <= max_side:
        return camera
    return camera.resized(
        max(1, round(camera.width * max_side / longest)), max(1, round(camera.height * max_side / longest))
    )
