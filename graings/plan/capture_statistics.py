"""CaptureStatistics: cheap measurements of a capture, on which the plan decides."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Sequence
from typing import Annotated, Final, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from graings.capture.capture import Capture, Frame
from graings.capture.images import ImageStore, shrink
from graings.document import Document
from graings.plan.tile_change import Change, gains, largest_change, noise_sigma

MAX_IMAGES: Final = 64
MAX_SIDE: Final = 256
# Large photographs take long to decode: fewer of them are looked at, so that the statistics stay below about 2 s.
MAX_SOURCE_PIXELS: Final = 40_000_000
LENS_COST: Final = 5  # undistorting an image takes as long as decoding one with five times as many pixels
MIN_IMAGES: Final = 8

# Coverage, detail and the noise of single images vary little between images: so many are enough.
TYPICAL_IMAGES: Final = 16

# A step of this many grey levels between neighbouring pixels counts as detail.
DETAIL_STEP: Final = 12 / 255
# A pixel farther than this from the background shows something.
VISIBLE_STEP: Final = 2 / 255

Image = NDArray[np.float32]
Positive = Annotated[int, Field(gt=0)]
Count = Annotated[int, Field(ge=0)]
Share = Annotated[float, Field(ge=0, le=1)]


class TileChange(Document):
    """The tile of 16 x 16 pixels that changed most between images of one fixed camera."""

    ratio: float = Field(ge=0, description="Its change over the most that the noise explains; above 1 it changed.")
    value: float = Field(ge=0, description="Root mean square difference of its pixels, values in [0, 1].")
    image: str = Field(description="File name of the image that differs.")
    tile: tuple[Count, Count] = Field(description="Column and row of the tile.")
    px: Positive = Field(description="Longest side in px of the images that were compared.")


class CaptureStatistics(Document):
    """What the training images of a capture show without any training."""

    images: Positive = Field(description="Training images.")
    examined: Positive = Field(description="Images whose pixels were looked at.")
    times: Positive = Field(description="Distinct training times.")
    cameras: Positive = Field(description="Distinct cameras: places, directions and focal lengths.")
    camera_motion: Literal["fixed", "moving", "mixed"] = Field(
        description="fixed: every camera sees several times; moving: none does; mixed: some do."
    )
    simultaneous: Positive = Field(description="Most images of one time.")
    width: Positive = Field(description="Width in px of the first image, as it is trained on.")
    height: Positive = Field(description="Height in px of the first image, as it is trained on.")
    pixels: Positive = Field(description="Mean number of pixels of an image, as it is trained on.")
    noise: float | None = Field(
        ge=0, description="Standard deviation of the noise, values in [0, 1], of the noisiest camera or image."
    )
    gain: tuple[float, float] | None = Field(
        description="Least and greatest gain of an image against the median of its camera; null with moving cameras."
    )
    offset: float | None = Field(
        ge=0, description="Greatest offset of brightness beside the gain, values in [0, 1]; null with moving cameras."
    )
    change: TileChange | None = Field(
        description="Largest change between times; null where not every camera is fixed and was looked at."
    )
    alpha: Literal["absent", "opaque", "varying"] = Field(
        description="absent: no alpha channel; opaque: 1 everywhere in the examined images; varying: neither."
    )
    points: Count = Field(description="Points of the capture's point cloud; 0 without one.")
    distorted: Count = Field(description="Training images that are undistorted when they are decoded.")
    coverage: Share = Field(description="Mean share of the pixels that differ from the background.")
    detail: Share = Field(
        description="Mean share of the pixels that differ from a neighbour by 12 grey levels of 255 or more."
    )
    cost_s: float = Field(ge=0, description="CPU seconds that this took, decoding included.")


def measure(capture: Capture, images: ImageStore, background: Sequence[float]) -> CaptureStatistics:
    """The statistics of the training images of `capture`, decoded by `images` on `background` (RGB in [0, 1]).

    At most 64 images are looked at, at most 256 px large; first, middle and last image of a fixed camera also at the
    size that is trained on. Raises `CaptureError` where an image cannot be read.
    """
    started = time.process_time()
    groups = _cameras(capture.train)
    sample = _sample(groups, _allowed(capture.train))
    fixed = [frames for frames in groups if len({frame.time for frame in frames}) > 1]
    typical = {frame.name for frame in sample[:: max(1, len(sample) // TYPICAL_IMAGES)]}
    small: dict[str, Image] = {}
    coverage, detail, opaque = [], [], True
    for frame in sample:
        image = _without_masked(images, frame, background)
        opaque = opaque and images.alpha(frame) is None
        if frame.name in typical:
            coverage.append(_coverage(image, background))
            detail.append(_detail(image))
        small[frame.name] = _reduced(image)
    examined = [[frame for frame in frames if frame.name in small] for frames in fixed]
    noise, gain, offset, change = _over_time(examined, small, images, background)
    testable = len(fixed) == len(groups) and all(len(frames) > 1 for frames in examined)
    camera = capture.train[0].camera
    if noise is None:
        noise = max(noise_sigma(image[None]) for name, image in small.items() if name in typical)
    counts = np.unique([frame.time for frame in capture.train], return_counts=True)[1]
    return CaptureStatistics(
        images=len(capture.train),
        examined=len(sample),
        times=len(capture.times),
        cameras=len(groups),
        camera_motion="fixed" if len(fixed) == len(groups) else "mixed" if fixed else "moving",
        simultaneous=int(counts.max()),
        width=camera.width,
        height=camera.height,
        pixels=round(np.mean([frame.camera.width * frame.camera.height for frame in capture.train])),
        noise=noise,
        gain=gain,
        offset=offset,
        change=change if testable else None,
        alpha="absent" if not capture.has_alpha else "opaque" if opaque else "varying",
        points=0 if capture.points is None else len(capture.points.positions),
        distorted=sum(frame.lens is not None for frame in capture.train),
        coverage=float(np.mean(coverage)),
        detail=float(np.mean(detail)),
        cost_s=time.process_time() - started,
    )


def _cameras(frames: Sequence[Frame]) -> list[list[Frame]]:
    """The frames of each camera in order of time; files repeat the pose of a fixed camera with the same digits."""
    groups: dict[object, list[Frame]] = {}
    for frame in frames:
        camera = frame.camera
        lens = (camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height)
        key = (camera.world_to_camera.tobytes(), lens)
        groups.setdefault(key, []).append(frame)
    return [sorted(group, key=lambda frame: frame.time) for group in groups.values()]


def _allowed(frames: Sequence[Frame]) -> int:
    pixels = 0.0
    for frame in frames:
        pixels += frame.source_size[0] * frame.source_size[1] * (LENS_COST if frame.lens else 1) / len(frames)
    return int(np.clip(MAX_SOURCE_PIXELS / pixels, MIN_IMAGES, MAX_IMAGES))


def _sample(groups: Sequence[Sequence[Frame]], most: int) -> list[Frame]:
    """At most `most` frames: first, last and middle of each camera, then some of every part of the rest.

    Within a part the name's hash decides: a regular stride would miss a motion of the same period.
    """
    chosen: dict[str, Frame] = {}
    if len(groups) <= most // 2:
        ends = [frames[0] for frames in groups] + [frames[-1] for frames in groups]
        middles = [frames[len(frames) // 2] for frames in groups]
        chosen = {frame.name: frame for frame in [*ends, *middles][:most]}
    rest = [frame for frames in groups for frame in frames if frame.name not in chosen]
    parts = np.array_split(np.arange(len(rest)), max(1, most - len(chosen))) if len(chosen) < most else []
    for part in parts:
        if len(part):
            frame = min((rest[index] for index in part), key=lambda f: hashlib.sha256(f.name.encode()).digest())
            chosen[frame.name] = frame
    return list(chosen.values())


def _over_time(
    cameras: Sequence[Sequence[Frame]], small: dict[str, Image], images: ImageStore, background: Sequence[float]
) -> tuple[float | None, tuple[float, float] | None, float | None, TileChange | None]:
    """Noise, range of gains, greatest offset and largest change of the fixed cameras; None without any."""
    noises: list[float] = []
    fits: list[NDArray[np.float64]] = []
    found: list[TileChange] = []

    def compare(frames: Sequence[Frame], stack: NDArray[np.float32]) -> None:
        sigma = noise_sigma(stack)
        fit = gains(stack, sigma)
        noises.append(sigma)
        fits.append(fit)
        found.append(_named(largest_change(stack, sigma, fit), frames, max(stack.shape[1:3])))

    for frames in cameras:
        if len(frames) < 2:
            continue
        compare(frames, np.stack([small[frame.name] for frame in frames]))
        if max(frames[0].camera.width, frames[0].camera.height) > MAX_SIDE:
            few = list({frame.name: frame for frame in (frames[0], frames[len(frames) // 2], frames[-1])}.values())
            compare(few, np.stack([_without_masked(images, frame, background) for frame in few]))
    if not found:
        return None, None, None, None
    every = np.concatenate(fits)
    gain = (float(every[:, 0].min()), float(every[:, 0].max()))
    return max(noises), gain, float(np.abs(every[:, 1]).max()), max(found, key=lambda change: change.ratio)


def _named(change: Change, frames: Sequence[Frame], px: int) -> TileChange:
    image = frames[change.pair[0] if change.pair[1] == -1 else change.pair[1]].name
    return TileChange(ratio=change.ratio, value=change.value, image=image, tile=change.tile, px=px)


def _without_masked(images: ImageStore, frame: Frame, background: Sequence[float]) -> Image:
    """The image [H, W, 3] with masked pixels in the colour of the background, which shows nothing."""
    image, valid = images.rgb(frame), images.valid(frame)
    return image if valid is None else np.where(valid[..., None], image, np.asarray(background, dtype=np.float32))


def _reduced(image: Image) -> Image:
    height, width = image.shape[:2]
    factor = max(height, width) / MAX_SIDE
    return image if factor <= 1 else shrink(image, max(1, round(width / factor)), max(1, round(height / factor)))


def _coverage(image: Image, background: Sequence[float]) -> float:
    away = np.abs(image - np.asarray(background, dtype=np.float32)).max(-1)
    return float((away > VISIBLE_STEP).mean())


def _detail(image: Image) -> float:
    steps = np.zeros(image.shape[:2], dtype=bool)
    steps[:, 1:] |= np.abs(np.diff(image, axis=1)).max(-1) >= DETAIL_STEP
    steps[1:] |= np.abs(np.diff(image, axis=0)).max(-1) >= DETAIL_STEP
    return float(steps.mean())
