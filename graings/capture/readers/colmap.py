"""Reader for COLMAP folders: a sparse model and `images/`.

The cameras are those of undistorted images; images are undistorted when they are decoded (`graings.capture.lens`).
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

from pydantic import ConfigDict, TypeAdapter

from graings.capture.capture import Split
from graings.capture.folder import CaptureFolder
from graings.capture.image_file import ImageFile
from graings.capture.raw_capture import RawCapture, RawFrame
from graings.capture.readers.colmap_camera import ColmapCamera, UndistortedCameras, image_scale, undistortion_notes
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
    """The folder of the COLMAP model relative to `root`, or None."""
    for folder in MODEL_FOLDERS:
        if any((root / folder / f"cameras{suffix}").is_file() for suffix in (".bin", ".txt")):
            return folder
    return None


def read_colmap(folder: CaptureFolder, config: CaptureConfig) -> RawCapture:
    """Every registered image with its undistorted camera, and the points.

    Times: `times.json` ({image name: time}) beside `images/`, or with `times_from_names` the last number in the file
    name, else none. Test split: the names in `test.txt` beside the model, else every `test_every`-th by name. Val
    split: every `test_every`-th of the rest (`split_held_out`). Raises `CaptureError`.
    """
    model_folder = find_model(folder.root)
    assert model_folder is not None  # load_capture chose this reader because there is one
    model = read_model(folder, model_folder)
    if not model.images:
        raise CaptureError(
            "the model has no registered image",
            file=model_folder,
            field="images",
            remedy="Run the reconstruction again.",
        )
    notes: list[str] = []
    frames = _frames(folder, model_folder, model, _times(folder, config, model), notes)
    splits = _splits(folder, model_folder, frames, config.test_every, notes)
    return RawCapture.with_points("colmap", splits, notes, model.positions, model.colors)


def _frames(
    folder: CaptureFolder, model_folder: str, model: ColmapModel, times: dict[str, float], notes: list[str]
) -> dict[str, RawFrame]:
    frames: dict[str, RawFrame] = {}
    cameras = UndistortedCameras(model_folder)
    rescaled = 0
    for image in sorted(model.images, key=lambda image: image.name):
        if image.name in frames:
            raise CaptureError(
                f"the image {image.name} is listed twice",
                file=model_folder,
                field="images",
                remedy="Export the model again.",
            )
        if image.camera_id not in model.cameras:
            raise CaptureError(
                f"the image {image.name} refers to camera {image.camera_id}, which is missing",
                file=model_folder,
                field="cameras",
                remedy="Export the model again.",
            )
        file = folder.image(f"images/{image.name}", source=model_folder, field=f"image {image.name!r}")
        distorted = _camera_for_file(model.cameras[image.camera_id], file, model_folder)
        rescaled += distorted is not model.cameras[image.camera_id]
        camera, lens = cameras.of(distorted, image.world_to_camera, "cameras")
        frames[image.name] = RawFrame(file, camera, times.get(image.name), lens)
    undistorted = undistortion_notes(frame.lens for frame in frames.values())
    notes += undistorted or ["images are not undistorted: no camera of the model has distortion"]
    if rescaled:
        notes.append(f"the model's cameras were scaled to the size of {rescaled} image files")
    return frames


def _camera_for_file(camera: ColmapCamera, file: ImageFile, model_folder: str) -> ColmapCamera:
    if (file.width, file.height) == (camera.width, camera.height):
        return camera
    if image_scale(file, camera.width, camera.height) is None:
        raise CaptureError(
            f"the camera is for {camera.width}x{camera.height} px, {file.name} has {file.width}x{file.height}",
            file=model_folder,
            field="cameras",
            remedy="Give the images from which the model was made.",
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


def _splits(
    folder: CaptureFolder, model_folder: str, frames: dict[str, RawFrame], every: int, notes: list[str]
) -> dict[Split, tuple[RawFrame, ...]]:
    list_file = next((file for file in (f"{model_folder}/{TEST_FILE}", TEST_FILE) if folder.has(file)), None)
    if list_file is None:
        return split_held_out(frames, every, notes, source=model_folder)
    test = {line.strip() for line in folder.read(list_file).decode("utf-8", errors="surrogateescape").splitlines()}
    unknown = sorted(test - set(frames) - {""})
    if unknown:
        raise CaptureError(
            f"{unknown[0]!r} is no image of the model", file=list_file, remedy="Correct or remove the name."
        )
    notes.append(f"test images are those of {list_file}")
    return split_held_out(frames, every, notes, source=list_file, test=test)
