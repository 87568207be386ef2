"""Reader for COLMAP folders: a sparse model and `images/`.

The cameras are those of undistorted images; images are undistorted when they are decoded (`graings.capture.lens`).
"""

from __future__ import annotations

from pathlib import PurePosixPath
from typing import Final

from pydantic import ConfigDict, TypeAdapter

from graings.capture.capture import Split
from graings.capture.folder import CaptureFolder
from graings.capture.image_file import ImageFile
from graings.capture.listed_images import ListedImages
from graings.capture.number_in_name import notes_on_points
from graings.capture.orientation import image_scale, named_size, oriented
from graings.capture.raw_capture import RawCapture, RawFrame
from graings.capture.readers.colmap_camera import ColmapCamera, UndistortedCameras, undistortion_notes
from graings.capture.readers.colmap_folder import MASKS, find_model, picture_folder
from graings.capture.readers.colmap_model import ColmapImage, ColmapModel, read_model
from graings.capture.readers.json_document import parse_json
from graings.capture.readers.rig import RigFrames, with_rig
from graings.capture.readers.transforms_document import SINGLE_FILE, parse_transforms
from graings.capture.splits import split_held_out, time_from_name
from graings.config import CaptureConfig
from graings.errors import CaptureError

TIMES_FILE: Final = "times.json"
TEST_FILE: Final = "test.txt"

_TIMES: Final = TypeAdapter(dict[str, float], config=ConfigDict(strict=True, allow_inf_nan=False))


def read_colmap(folder: CaptureFolder, config: CaptureConfig) -> RawCapture:
    """Every registered image with its undistorted camera, and the points.

    Times: `times.json` ({image name: time}) beside `images/`, or those of a `transforms.json` that lists the same
    images, or with `times_from_names` the number in the file name, else none. Masks: `masks/NAME.png`. Test split:
    the names in `test.txt` beside the model, where an image of a rig stands for its whole camera, else every
    `test_every`-th by name. Val split: every `test_every`-th of the rest (`split_held_out`). Raises `CaptureError`.
    """
    found = find_model(folder.root)
    assert found is not None  # load_capture chose this reader because there is one
    model = read_model(folder, found.folder)
    if not model.images:
        raise CaptureError(
            "the model has no registered image",
            file=found.folder,
            field="images",
            remedy="Run the reconstruction again.",
        )
    notes = found.notes()
    frames = with_rig(folder, _frames(folder, found.folder, model, config, notes), config, notes)
    splits = _splits(folder, found.folder, model, frames, config.test_every, notes)
    return RawCapture.with_points("colmap", splits, notes, model.positions, model.colors)


def _frames(
    folder: CaptureFolder, model_folder: str, model: ColmapModel, config: CaptureConfig, notes: list[str]
) -> dict[str, RawFrame]:
    frames: dict[str, RawFrame] = {}
    cameras = UndistortedCameras(model_folder)
    place, masks = (picture_folder(folder.root, model_folder, name) for name in ("images", MASKS))
    listed = ListedImages(folder, model_folder)
    times = _times(folder, config, model, place, notes)
    rescaled = 0
    for image in sorted(model.images, key=lambda image: image.name):
        _check_listed(image, model, frames, model_folder)
        file = listed.find(f"{place}/{image.name}", f"image {image.name!r}")
        if file is None:
            continue
        source = model.cameras[image.camera_id]
        file = oriented(file, source.width, source.height, config.orientation)
        distorted = _camera_for_file(source, file, model_folder)
        rescaled += distorted is not source
        camera, lens = cameras.of(distorted, image.world_to_camera, "cameras")
        mask = _mask(listed, masks, image.name, file)
        frames[image.name] = RawFrame(file, camera, times.get(image.name), lens, mask)
    notes += listed.notes()
    undistorted = undistortion_notes(frame.lens for frame in frames.values())
    notes += undistorted or ["images are not undistorted: no camera of the model has distortion"]
    if rescaled:
        notes.append(f"the model's cameras were scaled to the size of {rescaled} image files")
    return frames


def _check_listed(image: ColmapImage, model: ColmapModel, frames: dict[str, RawFrame], model_folder: str) -> None:
    problem = None
    if image.name in frames:
        problem, field = f"the image {image.name} is listed twice", "images"
    elif image.camera_id not in model.cameras:
        problem = f"the image {image.name} refers to camera {image.camera_id}, which is missing"
        field = "cameras"
    if problem is not None:
        raise CaptureError(problem, file=model_folder, field=field, remedy="Export the model again.")


def _mask(listed: ListedImages, masks: str, name: str, image: ImageFile) -> ImageFile | None:
    """The mask `masks/NAME.png`, as COLMAP names it, or with the suffix of the image replaced; None without one."""
    stem = str(PurePosixPath(name).with_suffix(""))
    candidates = [f"{masks}/{each}.png" for each in (name, stem)]
    found = next((candidate for candidate in candidates if listed.folder.has(candidate)), None)
    return None if found is None else listed.mask(found, image, f"image {name!r}")


def _camera_for_file(camera: ColmapCamera, file: ImageFile, model_folder: str) -> ColmapCamera:
    if (file.width, file.height) == (camera.width, camera.height):
        return camera
    if image_scale(file, camera.width, camera.height) is None:
        raise CaptureError(
            f"the camera is for {camera.width}x{camera.height} px, {file.name} has {named_size(file)}",
            file=model_folder,
            field="cameras",
            remedy="Give the images from which the model was made.",
        )
    return camera.scaled(file.width, file.height)


def _times(
    folder: CaptureFolder, config: CaptureConfig, model: ColmapModel, place: str, notes: list[str]
) -> dict[str, float]:
    names = [image.name for image in model.images]
    if folder.has(TIMES_FILE):
        times = parse_json(_TIMES, folder.read(TIMES_FILE), TIMES_FILE)
        missing = next((name for name in names if name not in times), None)
        if missing is not None:
            raise CaptureError("the time is missing", file=TIMES_FILE, field=missing, remedy="Give every image a time.")
        return times
    if folder.has(SINGLE_FILE):
        times = _times_of_transforms(folder, names, place, notes)
        if times:
            return times
    if not config.times_from_names or config.rig:
        return {}
    notes += notes_on_points([f"{place}/{name}" for name in names])
    return {name: time_from_name(f"{place}/{name}") for name in names}


def _times_of_transforms(folder: CaptureFolder, names: list[str], place: str, notes: list[str]) -> dict[str, float]:
    """Times of the images `names` by `transforms.json`, if it gives all of them one."""
    try:
        content = parse_transforms(folder, SINGLE_FILE)
    except CaptureError as error:
        notes.append(f"the COLMAP model is read; {SINGLE_FILE} beside it cannot be used for times ({error.problem})")
        return {}
    given: dict[str, float] = {}
    for entry in content.frames:
        path = PurePosixPath(entry.file_path.replace("\\", "/"))
        if entry.time is not None:
            given[str(path)] = given[path.stem] = entry.time
    times: dict[str, float] = {}
    for name in names:
        time = given.get(f"{place}/{name}", given.get(PurePosixPath(name).stem))
        if time is not None:
            times[name] = time
    if len(times) == len(names):
        notes.append(f"cameras and points are those of the COLMAP model, times those of {SINGLE_FILE}, by file name")
        return times
    notes.append(
        f"the COLMAP model is read; {SINGLE_FILE} beside it gives {len(times)} of {len(names)} images a time and is "
        "not used"
    )
    return {}


def _splits(
    folder: CaptureFolder, model_folder: str, model: ColmapModel, rig: RigFrames, every: int, notes: list[str]
) -> dict[Split, tuple[RawFrame, ...]]:
    list_file = next((file for file in (f"{model_folder}/{TEST_FILE}", TEST_FILE) if folder.has(file)), None)
    if list_file is None:
        return split_held_out(rig.frames, every, notes, source=model_folder)
    text = folder.read(list_file).decode("utf-8-sig", errors="surrogateescape")
    listed = {line.strip() for line in text.splitlines()}
    registered = {image.name for image in model.images}  # a few of them may be missing on disk
    unknown = sorted(listed - registered - set(rig.frames) - {""})
    if unknown:
        raise CaptureError(
            f"{unknown[0]!r} is no image of the model", file=list_file, remedy="Correct or remove the name."
        )
    test = {frame for name in listed for frame in rig.named(name)}
    if listed - {""} and not test:
        notes.append(f"{list_file} is left out: none of its images is there")
        return split_held_out(rig.frames, every, notes, source=model_folder)
    notes.append(f"the {len(test)} test images are those of {list_file}")
    return split_held_out(rig.frames, every, notes, source=list_file, test=test)
