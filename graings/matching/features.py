"""SIFT features of images, and their matches between neighbouring cameras. Extracted by pycolmap, an optional extra."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from graings.camera.camera import Camera
from graings.capture.capture import Frame
from graings.capture.images import ImageStore
from graings.colmap import import_pycolmap

if TYPE_CHECKING:
    import pycolmap

Array = NDArray[np.float64]

# Number of nearest neighbours that each image is matched with.
NEIGHBOURS: Final = 8

# Longer image side for SIFT in px: it takes a second; with four times as many 14 s and 3 GB.
MAX_SIFT_SIDE: Final = 1000

# Features per image, the strongest ones. SIFT finds 200 to 400 in an image of 400 px.
MAX_FEATURES: Final = 4096

# A feature's best match must be this much closer, as an angle between descriptors, than its second best (Lowe 2004).
RATIO: Final = 0.8

# Cosine between optical axes: cameras more than 60 degrees apart seldom see the same surface.
MIN_AXIS_COSINE: Final = 0.5

LUMA: Final = np.array([0.299, 0.587, 0.114], np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class Features:
    """SIFT features of one image: pixels [n, 2] (x, y) and unit descriptors [n, 128]."""

    pixels: Array
    descriptors: Tensor


def extract(frames: Sequence[Frame], images: ImageStore) -> list[Features]:
    """The features of each of `frames` that are not masked. Raises `ImportError` without pycolmap."""
    pycolmap = import_pycolmap()  # optional extra: importing it at the top would make every capture depend on it
    options = pycolmap.FeatureExtractionOptions()
    options.sift.max_num_features = MAX_FEATURES
    extractor = pycolmap.FeatureExtractor.create(options, pycolmap.Device.cpu)
    return [_features(images.rgb(frame) @ LUMA, images.valid(frame), extractor) for frame in frames]


def reduced(frame: Frame, most: int) -> Frame:
    """`frame` with a camera of at most `most` px along its longer side."""
    camera, longest = frame.camera, max(frame.camera.width, frame.camera.height)
    if longest <= most:
        return frame
    width, height = (max(1, round(side * most / longest)) for side in (camera.width, camera.height))
    return replace(frame, camera=camera.resized(width, height))


def _features(
    gray: NDArray[np.float32], valid: NDArray[np.bool_] | None, extractor: pycolmap.FeatureExtractor
) -> Features:
    points, descriptors = extractor.extract_from_float32_array(gray)
    pixels = np.array([(point.x, point.y) for point in points], dtype=np.float64).reshape(-1, 2)
    unit = functional.normalize(torch.from_numpy(np.array(descriptors.data)).float(), dim=-1)
    if valid is None:
        return Features(pixels, unit)
    kept = at(valid, pixels)
    return Features(pixels[kept], unit[torch.from_numpy(kept)])


def at(valid: NDArray[np.bool_], pixels: Array) -> NDArray[np.bool_]:
    """Values of `valid` [H, W] at positions [n, 2] (x, y) in px, of the nearest pixel outside the image."""
    columns, rows = (np.clip(pixels[:, axis].astype(np.intp), 0, valid.shape[1 - axis] - 1) for axis in (0, 1))
    return np.asarray(valid[rows, columns])


def neighbours(cameras: Sequence[Camera], times: Sequence[float]) -> Iterator[tuple[int, int]]:
    """Pairs of each camera and its nearest others with a similar viewing direction; ties by time."""
    centers = np.stack([camera.center for camera in cameras])
    forwards = np.stack([camera.forward for camera in cameras])
    moments = np.asarray(times)
    apart = np.linalg.norm(centers[:, None] - centers, axis=-1)
    useful = (forwards @ forwards.T > MIN_AXIS_COSINE) & (apart > 1e-6 * max(1.0, float(apart.max())))
    pairs: set[tuple[int, int]] = set()
    for one in range(len(cameras)):
        order = np.lexsort((np.abs(moments - moments[one]), apart[one].round(6)))
        nearest = order[useful[one][order]][:NEIGHBOURS].tolist()
        pairs.update((min(one, other), max(one, other)) for other in nearest)
    yield from sorted(pairs)


def matches(one: Tensor, other: Tensor) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Indices of mutual best matches that pass the ratio test."""
    if len(one) == 0 or len(other) < 2:
        nothing = np.empty(0, np.int64)
        return nothing, nothing
    similarity = one @ other.T
    closest, index = similarity.topk(2, dim=-1)
    angles = closest.clamp(-1.0, 1.0).acos()
    mutual = similarity.argmax(0)[index[:, 0]] == torch.arange(len(one))
    kept = (mutual & (angles[:, 0] < RATIO * angles[:, 1])).nonzero().squeeze(-1)
    return kept.numpy(), index[kept, 0].numpy()
