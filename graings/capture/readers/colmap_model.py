"""ColmapModel: the three files of a sparse COLMAP model, binary or text, as plain records.

They are not read through pycolmap, because its readers do not return from a truncated images.bin and accept a truncated
cameras.bin without an error.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NoReturn

import numpy as np
from numpy.typing import NDArray

from graings.capture.folder import CaptureFolder
from graings.capture.readers.colmap_camera import (
    CAMERA_MODELS,
    MODELS,
    PANORAMA_REMEDY,
    PANORAMIC_MODELS,
    ColmapCamera,
    panorama_problem,
)
from graings.errors import CaptureError

MIN_QUATERNION_NORM = 1e-6
MAX_SIZE = 1_000_000  # px: the images themselves may be much smaller


@dataclass(frozen=True, slots=True, eq=False)
class ColmapImage:
    """A registered image: pose [4, 4] world to camera, OpenCV axes, in the model's unit."""

    name: str
    camera_id: int
    world_to_camera: NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class ColmapModel:
    """A sparse model; points [M, 3] and their colours [M, 3] in [0, 1]."""

    cameras: dict[int, ColmapCamera]
    images: tuple[ColmapImage, ...]
    positions: NDArray[np.float64]
    colors: NDArray[np.float32]


def read_model(folder: CaptureFolder, model_folder: str) -> ColmapModel:
    """The model in `model_folder`. Raises `CaptureError` for missing or truncated files and impossible values."""
    suffix = ".bin" if folder.has(f"{model_folder}/cameras.bin") else ".txt"
    names = [f"{model_folder}/{part}{suffix}" for part in ("cameras", "images", "points3D")]
    contents = [folder.read(name) for name in names]
    if suffix == ".bin":
        files = [_Binary(name, data) for name, data in zip(names, contents, strict=True)]
        model = ColmapModel(_cameras_bin(files[0]), _images_bin(files[1]), *_points_bin(files[2]))
        for file in files:
            file.finish()
        return model
    texts = [_Text(name, data) for name, data in zip(names, contents, strict=True)]
    return ColmapModel(_cameras_txt(texts[0]), _images_txt(texts[1]), *_points_txt(texts[2]))


class _Binary:
    """A little-endian file that is read sequentially; reading past its end raises `CaptureError`."""

    def __init__(self, name: str, data: bytes) -> None:
        self.name, self.data, self.position = name, data, 0

    def take(self, layout: str) -> tuple[float, ...]:
        start = self.skip(struct.calcsize(layout))
        return struct.unpack_from(layout, self.data, start)

    def skip(self, size: int) -> int:
        start = self.position
        if start + size > len(self.data):
            raise CaptureError("is truncated", file=self.name, remedy="Copy the model again.")
        self.position += size
        return start

    def text(self) -> str:
        end = self.data.find(b"\0", self.position)
        start = self.skip((end if end >= 0 else len(self.data)) + 1 - self.position)
        return self.data[start:end].decode("utf-8", errors="surrogateescape")

    def count(self) -> range:
        return range(int(self.take("<Q")[0]))

    def finish(self) -> None:
        if self.position != len(self.data):
            self.fail(f"{len(self.data) - self.position} bytes too many")

    def fail(self, problem: str) -> NoReturn:
        raise CaptureError(problem, file=self.name, remedy="Export the model again.")


class _Text:
    """Lines of a text model; comments are skipped, empty lines matter in images.txt only."""

    def __init__(self, name: str, data: bytes) -> None:
        self.name = name
        self.lines = data.decode("utf-8", errors="surrogateescape").splitlines()

    def rows(self) -> Iterator[tuple[int, str]]:
        for number, line in enumerate(self.lines):
            if line.strip() and not line.lstrip().startswith("#"):
                yield number, line

    def fail(self, number: int, problem: str) -> NoReturn:
        raise CaptureError(problem, file=self.name, field=f"line {number + 1}", remedy="Export the model again.")

    def finish(self, entries: int) -> None:
        # COLMAP writes the count in a comment. Only it shows that a file was truncated between two lines.
        for line in self.lines:
            if line.startswith("# Number of "):
                stated = line.partition(":")[2].partition(",")[0].strip()
                if stated.isdecimal() and stated.lstrip("0") != str(entries).lstrip("0"):
                    raise CaptureError(
                        f"declares {stated} entries and contains {entries}",
                        file=self.name,
                        remedy="Copy the model again, or correct the comment if entries were removed on purpose.",
                    )


def _cameras_bin(file: _Binary) -> dict[int, ColmapCamera]:
    cameras: dict[int, ColmapCamera] = {}
    for _ in file.count():
        identifier, model, width, height = (int(value) for value in file.take("<IiQQ"))
        if model in PANORAMIC_MODELS:
            raise _panorama(file.name, f"camera {identifier}", PANORAMIC_MODELS[model])
        if model not in CAMERA_MODELS:
            file.fail(f"camera {identifier} has the unknown model {model}")
        name, count, _ = CAMERA_MODELS[model]
        cameras[identifier] = _camera(file, identifier, name, width, height, file.take(f"<{count}d"))
    return cameras


def _images_bin(file: _Binary) -> tuple[ColmapImage, ...]:
    images = []
    for _ in file.count():
        values = file.take("<I7dI")
        name = file.text()
        file.skip(24 * int(file.take("<Q")[0]))
        images.append(ColmapImage(name, int(values[8]), _pose(file.name, name, values[1:8])))
    return tuple(images)


def _points_bin(file: _Binary) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    rows = []
    for _ in file.count():
        values = file.take("<Q3d3BdQ")
        file.skip(8 * int(values[8]))
        rows.append(values[1:7])
    return _points(rows)


def _cameras_txt(file: _Text) -> dict[int, ColmapCamera]:
    cameras: dict[int, ColmapCamera] = {}
    for number, line in file.rows():
        words = line.split()
        try:
            identifier, name, width, height = int(words[0]), words[1], int(words[2]), int(words[3])
            params = tuple(float(word) for word in words[4:])
        except (ValueError, IndexError):
            file.fail(number, "is no camera (id, model, width, height, parameters)")
        if name in PANORAMIC_MODELS.values():
            raise _panorama(file.name, f"line {number + 1}", name)
        if name not in MODELS:
            file.fail(number, f"camera {identifier} has the unknown model {name}")
        cameras[identifier] = _camera(file, identifier, name, width, height, params, number)
    file.finish(len(cameras))
    return cameras


def _panorama(file: str, field: str, model: str) -> CaptureError:
    return CaptureError(panorama_problem(model), file=file, field=field, remedy=PANORAMA_REMEDY)


def _images_txt(file: _Text) -> tuple[ColmapImage, ...]:
    images = []
    skip = -1  # each image takes two lines; the second, its observations, may be empty
    single = _lacks_observations(file)
    for number, line in file.rows():
        if number == skip:
            continue
        words = line.split(maxsplit=9)
        try:
            values = tuple(float(word) for word in words[1:8])
            camera, name = int(words[8]), words[9].strip()
        except (ValueError, IndexError):
            file.fail(number, "is no image (id, quaternion, translation, camera id, name)")
        skip = -1 if single else number + 1
        if not single and skip < len(file.lines) and len(file.lines[skip].split()) % 3:
            file.fail(skip, f"the observations of {name} are truncated")
        images.append(ColmapImage(name, camera, _pose(file.name, name, values)))
    file.finish(len(images))
    return tuple(images)


def _lacks_observations(file: _Text) -> bool:
    """Whether each image has one line only, as scripts write that do not know of the second.

    Ten words or more whose last is no number are an image; observations are three numbers each.
    """
    return all(is_image_line(line) for _, line in file.rows()) and len(list(file.rows())) > 1


def is_image_line(line: str) -> bool:
    """Whether a line of images.txt is an image, not the observations of one."""
    words = line.split(maxsplit=9)
    try:
        float(words[9])
    except ValueError:
        return True
    except IndexError:
        pass
    return False


def _points_txt(file: _Text) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    rows = []
    for number, line in file.rows():
        words = line.split()
        try:
            if len(words) < 8 or len(words) % 2:
                raise ValueError
            rows.append(tuple(float(word) for word in words[1:7]))
        except ValueError:
            file.fail(number, "is no point (id, position, colour, error, track)")
    file.finish(len(rows))
    return _points(rows)


def _camera(
    file: _Binary | _Text,
    identifier: int,
    model: str,
    width: int,
    height: int,
    params: tuple[float, ...],
    number: int = 0,
) -> ColmapCamera:
    count, focals = MODELS[model]
    problem = None
    if len(params) != count:
        problem = f"camera {identifier} ({model}) needs {count} parameters, has {len(params)}"
    elif not all(math.isfinite(value) for value in params) or min(params[:focals]) <= 0:
        problem = f"camera {identifier} needs finite parameters and positive focal lengths, has {params}"
    elif not 1 <= min(width, height) <= max(width, height) <= MAX_SIZE:
        problem = f"camera {identifier} has the size {width}x{height}"
    if problem is None:
        return ColmapCamera(model, width, height, tuple(float(value) for value in params))
    if isinstance(file, _Text):
        file.fail(number, problem)
    file.fail(problem)


def _pose(file: str, name: str, values: tuple[float, ...]) -> NDArray[np.float64]:
    """World to camera from a quaternion (w, x, y, z) of any length and a translation."""
    if not all(math.isfinite(value) for value in values):
        raise CaptureError("the pose is not finite", file=file, field=name, remedy="Register the image again.")
    quaternion = np.array(values[:4])
    length = float(np.linalg.norm(quaternion))
    if length < MIN_QUATERNION_NORM:
        raise CaptureError("the rotation is zero", file=file, field=name, remedy="Register the image again.")
    w, x, y, z = quaternion / length
    pose = np.eye(4)
    pose[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    pose[:3, 3] = values[4:]
    return pose


def _points(rows: list[tuple[float, ...]]) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    values = np.array(rows, dtype=np.float64).reshape(-1, 6)
    return values[:, :3].copy(), (np.clip(values[:, 3:], 0, 255) / 255).astype(np.float32)
