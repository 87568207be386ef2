"""Reader for COLMAP folders: a sparse model and `images/`.

Cameras come out undistorted; the remap itself happens when an image is decoded (`graings.capture.lens`). Knows nothing
of pixels or of normalised units.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

from pydantic import ConfigDict, TypeAdapter

from graings.camera.camera import Camera
from graings.capture.capture import Split
from graings.capture.folder import CaptureFolder
from graings.capture.image_file import ImageFile
from graings.capture.lens import Lens
from graings.capture.raw_capture import RawCapture, RawFrame
from graings.capture.readers.colmap_camera import ColmapCamera
from graings.capture.readers.colmap_model import ColmapModel, read_model
from graings.capture.readers.json_document import parse_json
from graings.capture.splits import split_held_out, time_from_name
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


def read_colmap(folder: CaptureFolder, config: CaptureConfig) -> RawCapture:
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
    return RawCapture.with_points("colmap", splits, notes, model.positions, model.colors)


def _shots(
    folder: CaptureFolder, where: str, model: ColmapModel, times: dict[str, float], notes: list[str]
) -> dict[str, RawFrame]:
    shots: dict[str, RawFrame] = {}
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
            lenses[camera] = camera.lens(where, "cameras")
        lens = lenses[camera]
        pinhole, size = (
            (camera.pinhole, (camera.width, camera.height)) if lens is None else (lens.pinhole, lens.pinhole_size)
        )
        shots[image.name] = RawFrame(file, Camera(image.world_to_camera, *pinhole, *size), times.get(image.name), lens)
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
    return {name: time_from_name(f"images/{name}") for name in names}


def _split(
    folder: CaptureFolder, where: str, shots: dict[str, RawFrame], every: int, notes: list[str]
) -> dict[Split, tuple[RawFrame, ...]]:
    listed = next((file for file in (f"{where}/{TEST_FILE}", TEST_FILE) if folder.has(file)), None)
    if listed is None:
        return split_held_out(shots, every, notes, source=where)
    test = {line.strip() for line in folder.read(listed).decode("utf-8", errors="surrogateescape").splitlines()}
    unknown = sorted(test - set(shots) - {""})
    if unknown:
        raise CaptureError(
            f"{unknown[0]!r} is no image of the model", file=listed, remedy="Correct the name or take it out."
        )
    notes.append(f"test images are those of {listed}")
    return split_held_out(shots, every, notes, source=listed, test=test)
