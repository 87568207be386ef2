"""Reader for COLMAP folders: a sparse model and `images/`.

Cameras come out undistorted; the remap itself happens when an image is decoded (`graings.capture.lens`). Knows nothing
of pixels or of normalised units.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Final

import numpy as np
from pydantic import ConfigDict, TypeAdapter

from graings.camera import Camera
from graings.capture.capture import Split
from graings.capture.colmap_model import ColmapCamera, ColmapModel, read_model
from graings.capture.folder import CaptureFolder
from graings.capture.image_file import ImageFile
from graings.capture.json_document import parse_json
from graings.capture.lens import Lens
from graings.capture.recording import FARTHEST, Recording, Shot
from graings.config import CaptureConfig
from graings.errors import CaptureError

MODEL_FOLDERS: Final = ("sparse/0", "sparse", ".")
TIMES_FILE: Final = "times.json"
TEST_FILE: Final = "test.txt"

_TIMES: Final = TypeAdapter(dict[str, float], config=ConfigDict(strict=True, allow_inf_nan=False))


def find_model(root: Path) -> str | None:
    """Where in `root` the COLMAP model lies, or None."""
    for where in MODEL_FOLDERS:
        if any((root / where / f"cameras{suffix}").is_file() for suffix in (".bin", ".txt")):
            return where
    return None


def read_colmap(folder: CaptureFolder, config: CaptureConfig) -> Recording:
    """Every registered image with its undistorted camera, and the points.

    Times: `times.json` ({image name: time}) beside `images/`, or the last number in the file name when
    `times_from_names` asks for it, else none. Held out for test: the names in `test.txt` beside the model, else every
    `test_every`-th by name; for val every `test_every`-th of the rest, half a period later. Raises `CaptureError`.
    """
    where = find_model(folder.root)
    assert where is not None  # load_capture chose this reader because there is one
    model = read_model(folder, where)
    if not model.images:
        raise CaptureError(
            "the model has no registered image", file=where, field="images", remedy="Run the reconstruction again."
        )
    notes: list[str] = []
    shots = _shots(folder, where, model, _times(folder, config, model), notes)
    splits = _split(folder, where, shots, config.test_every, notes)
    finite = np.asarray((np.abs(model.positions) <= FARTHEST).all(axis=1))  # False for NaN as well
    if not finite.all():
        notes.append(f"{int((~finite).sum())} of {len(finite)} points are not finite or absurdly far and left out")
    if not finite.any():
        return Recording("colmap", splits, tuple(notes))
    return Recording("colmap", splits, tuple(notes), model.positions[finite], model.colors[finite])


def _shots(
    folder: CaptureFolder, where: str, model: ColmapModel, times: dict[str, float], notes: list[str]
) -> dict[str, Shot]:
    shots: dict[str, Shot] = {}
    lenses: dict[ColmapCamera, Lens | None] = {}
    rescaled = 0
    for image in sorted(model.images, key=lambda image: image.name):
        if image.name in shots:
            raise CaptureError(
                f"the image {image.name} is listed twice", file=where, field="images", remedy="Export the model again."
            )
        if image.camera_id not in model.cameras:
            raise CaptureError(
                f"the image {image.name} refers to camera {image.camera_id}, which is missing",
                file=where,
                field="cameras",
                remedy="Export the model again.",
            )
        file = folder.image(f"images/{image.name}", source=where, field=f"image {image.name!r}")
        camera = _sized(model.cameras[image.camera_id], file, where)
        rescaled += camera is not model.cameras[image.camera_id]
        if camera not in lenses:
            lenses[camera] = _lens(camera, where)
        lens = lenses[camera]
        pinhole, size = (
            (camera.pinhole, (camera.width, camera.height)) if lens is None else (lens.pinhole, lens.pinhole_size)
        )
        shots[image.name] = Shot(file, Camera(image.world_to_camera, *pinhole, *size), times.get(image.name), lens)
    if all(lens is None for lens in lenses.values()):
        notes.append("undistortion left out: no camera of the model bends its picture")
    else:
        names = ", ".join(sorted({lens.model for lens in lenses.values() if lens is not None}))
        notes.append(f"images are undistorted when decoded ({names})")
    if rescaled:
        notes.append(f"the model's cameras were scaled to the size of {rescaled} image files")
    return shots


def _sized(camera: ColmapCamera, file: ImageFile, where: str) -> ColmapCamera:
    if (file.width, file.height) == (camera.width, camera.height):
        return camera
    sx, sy = file.width / camera.width, file.height / camera.height
    if abs(sx - sy) * min(camera.width, camera.height) > 1.0:  # more than rounding the shorter side explains
        raise CaptureError(
            f"the camera is for {camera.width}x{camera.height} px, {file.name} has {file.width}x{file.height}",
            file=where,
            field="cameras",
            remedy="Give the images that the model was made from.",
        )
    return camera.scaled(file.width, file.height)


def _lens(camera: ColmapCamera, where: str) -> Lens | None:
    try:
        return Lens.of(camera.model, camera.params, (camera.width, camera.height), camera.distortion)
    except ImportError as error:
        raise CaptureError(
            f"the camera model {camera.model} must be undistorted, which needs pycolmap",
            file=where,
            field="cameras",
            remedy="Install it with `pip install graings[colmap]`, or undistort with `colmap image_undistorter`.",
        ) from error
    except ValueError as error:
        raise CaptureError(
            f"the camera {camera.model} {camera.params} cannot be undistorted ({error})",
            file=where,
            field="cameras",
            remedy="Undistort with `colmap image_undistorter` and give its output.",
        ) from error


def _times(folder: CaptureFolder, config: CaptureConfig, model: ColmapModel) -> dict[str, float]:
    names = [image.name for image in model.images]
    if folder.has(TIMES_FILE):
        times = parse_json(_TIMES, folder.read(TIMES_FILE), TIMES_FILE)
        missing = next((name for name in names if name not in times), None)
        if missing is not None:
            raise CaptureError("the time is missing", file=TIMES_FILE, field=missing, remedy="Give every image a time.")
        return times
    if not config.times_from_names:
        return {}
    times = {}
    for name in names:
        numbers = re.findall(r"\d+", Path(name).stem)
        if not numbers:
            raise CaptureError(
                "the file name holds no number to take the time from",
                file=f"images/{name}",
                field="name",
                remedy="Rename it, write times.json, or switch capture.times_from_names off.",
            )
        times[name] = float(numbers[-1])
    return times


def _split(
    folder: CaptureFolder, where: str, shots: dict[str, Shot], every: int, notes: list[str]
) -> dict[Split, tuple[Shot, ...]]:
    names = list(shots)
    listed = next((file for file in (f"{where}/{TEST_FILE}", TEST_FILE) if folder.has(file)), None)
    if listed is not None:
        test = {line.strip() for line in folder.read(listed).decode("utf-8", errors="surrogateescape").splitlines()}
        unknown = sorted(test - set(names) - {""})
        if unknown:
            raise CaptureError(
                f"{unknown[0]!r} is no image of the model", file=listed, remedy="Correct the name or take it out."
            )
        notes.append(f"test images are those of {listed}")
    else:
        test = set(names[::every]) if len(names) > 1 else set()
        notes.append(f"no split is given: every {every}th image by name is held out for test ({len(test)})")
    rest = [name for name in names if name not in test]
    val = set(rest[every // 2 :: every])
    notes.append(f"of the other images every {every}th is held out for val ({len(val)})")
    train = [name for name in rest if name not in val]
    if not train:
        raise CaptureError("leaves no training image", file=listed or where, remedy="Hold fewer images out.")
    return {
        "train": tuple(shots[name] for name in train),
        "val": tuple(shots[name] for name in rest if name in val),
        "test": tuple(shots[name] for name in names if name in test),
    }
