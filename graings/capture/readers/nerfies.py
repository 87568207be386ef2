"""Reader for the layout of Nerfies, HyperNeRF and DyCheck: `dataset.json`, `metadata.json`, `camera/`, `rgb/`.

`orientation` is the rotation from world to camera with OpenCV's axes, `position` the camera's centre. `scene.json`
holds the change of units that Nerfies makes itself; points and cameras are stored before it, and `normalize` makes its
own.
"""

from __future__ import annotations

from typing import Annotated, Final

import numpy as np
from pydantic import AliasChoices, BaseModel, ConfigDict, Field, TypeAdapter

from graings.capture.capture import Split
from graings.capture.folder import CaptureFolder
from graings.capture.image_file import ImageFile
from graings.capture.listed_images import ListedImages
from graings.capture.orientation import image_scale, named_size
from graings.capture.raw_capture import RawCapture, RawFrame
from graings.capture.readers.array_file import read_array
from graings.capture.readers.colmap_camera import ColmapCamera, UndistortedCameras, undistortion_notes
from graings.capture.readers.json_document import parse_json
from graings.capture.readers.rig import refuse_rig
from graings.capture.splits import split_held_out
from graings.config import CaptureConfig
from graings.errors import CaptureError

DATASET, METADATA, CAMERAS, POINTS = "dataset.json", "metadata.json", "camera", "points.npy"
# Masks of the pixels of a held-out image that training images show, too (DyCheck).
COVISIBLE: Final = "covisible"

# Rotations written in single precision differ from one by up to this.
RIGID_TOLERANCE: Final = 1e-3

Vector = tuple[float, float, float]
# JSON has integers of any length, which are no floats.
Number = Annotated[int, Field(ge=-(2**53), le=2**53)]
Side = Annotated[int, Field(gt=0, le=1_000_000)]


class _Document(BaseModel):
    model_config = ConfigDict(extra="ignore", allow_inf_nan=False)


class Dataset(_Document):
    """Names of all images, and those of the splits."""

    ids: Annotated[list[str], Field(min_length=1)]
    train_ids: list[str] | None = None
    val_ids: list[str] | None = None


class Entry(_Document):
    """Numbers of one image; its time is `time_id`, or `warp_id` as in Nerfies."""

    warp_id: Number | None = None
    time_id: Number | None = None
    camera_id: Number | None = None

    @property
    def time(self) -> int | None:
        """The number of its instant."""
        return self.warp_id if self.time_id is None else self.time_id


class CameraEntry(_Document):
    """A camera of `camera/`."""

    orientation: tuple[Vector, Vector, Vector]
    position: Vector
    focal_length: Annotated[float, Field(gt=0)]
    principal_point: tuple[float, float]
    image_size: tuple[Side, Side]
    skew: float = 0.0
    pixel_aspect_ratio: Annotated[float, Field(gt=0)] = 1.0
    radial_distortion: Vector = (0.0, 0.0, 0.0)
    # Nerfies called it `tangential` first, and reads that key still.
    tangential_distortion: tuple[float, float] = Field(
        (0.0, 0.0), validation_alias=AliasChoices("tangential", "tangential_distortion")
    )


_DATASET, _CAMERA = TypeAdapter(Dataset), TypeAdapter(CameraEntry)
_METADATA: Final = TypeAdapter(dict[str, Entry])


def is_nerfies(folder_names: set[str]) -> bool:
    """Whether a folder with these names has the layout."""
    return {DATASET, METADATA, CAMERAS} <= folder_names


def read_nerfies(folder: CaptureFolder, config: CaptureConfig) -> RawCapture:
    """The images of `rgb/<scale>x`, at the smallest scale that is still as large as `max_side`.

    The splits are `train_ids` and `val_ids`; without `val_ids` images are held out (`split_held_out`). Raises
    `CaptureError` naming file and field.
    """
    refuse_rig(config, DATASET)
    dataset = parse_json(_DATASET, folder.read(DATASET), DATASET)
    metadata = parse_json(_METADATA, folder.read(METADATA), METADATA)
    scale = _scale(folder, dataset.ids[0], config.max_side)
    listed = ListedImages(folder, DATASET)
    cameras = UndistortedCameras(CAMERAS)
    frames: dict[str, RawFrame] = {}
    held_out = set(dataset.val_ids or ())
    for name in dataset.ids:
        if name not in metadata:
            raise CaptureError("the entry is missing", file=METADATA, field=name, remedy="Export the capture again.")
        image = listed.find(f"rgb/{scale}/{name}.png", f"ids {name!r}")
        if image is None:
            continue
        file = f"{CAMERAS}/{name}.json"
        entry = parse_json(_CAMERA, folder.read(file), file)
        camera, lens = cameras.of(_distorted(entry, image, file), _world_to_camera(entry, file), name)
        mask = f"{COVISIBLE}/{scale}/val/{name}.png"
        valid = listed.mask(mask, image, f"ids {name!r}") if name in held_out and folder.has(mask) else None
        time = metadata[name].time
        frames[name] = RawFrame(image, camera, None if time is None else float(time), lens, valid)
    notes = [f"images are those of rgb/{scale}", *listed.notes()]
    notes += undistortion_notes(frame.lens for frame in frames.values())
    splits = _splits(dataset, frames, config, notes)
    if not folder.has(POINTS):
        return RawCapture("nerfies", splits, tuple(notes))
    points = read_array(folder, POINTS, columns=3)
    notes.append(f"{POINTS} has no colours")
    return RawCapture.with_points("nerfies", splits, notes, points, np.full(points.shape, 0.5, np.float32))


def _splits(
    dataset: Dataset, frames: dict[str, RawFrame], config: CaptureConfig, notes: list[str]
) -> dict[Split, tuple[RawFrame, ...]]:
    train = set(frames if dataset.train_ids is None else dataset.train_ids) - set(dataset.val_ids or ())
    training = {name: frame for name, frame in frames.items() if name in train}
    held_out = tuple(frame for name, frame in frames.items() if name in set(dataset.val_ids or ()))
    if not training:
        raise CaptureError("leaves no training image", file=DATASET, field="train_ids", remedy="List training images.")
    if not held_out:
        return split_held_out(training, config.test_every, notes, source=DATASET)
    return {"train": tuple(training.values()), "val": held_out}


def _scale(folder: CaptureFolder, name: str, max_side: int | None) -> str:
    """The folder below `rgb` that is read: the most reduced one whose images still have `max_side` px."""
    scales = sorted(
        (path.name for path in (folder.root / "rgb").glob("*x") if path.is_dir() and path.name[:-1].isdecimal()),
        key=lambda scale: int(scale[:-1]),
    )
    if not scales:
        raise CaptureError(
            "has no folder of pictures such as rgb/1x or rgb/2x",
            file="rgb",
            remedy="Add the pictures of the capture; metadata and cameras alone do not make one.",
        )
    for scale in reversed(scales):
        image = folder.find_image(f"rgb/{scale}/{name}.png", source=DATASET, field="ids")
        if max_side is not None and image is not None and max(image.width, image.height) >= max_side:
            return scale
    return scales[0]


def _distorted(entry: CameraEntry, image: ImageFile, file: str) -> ColmapCamera:
    width, height = entry.image_size
    if abs(entry.skew) > 1e-6 * entry.focal_length:
        raise CaptureError(f"is {entry.skew:g}", file=file, field="skew", remedy="Undistort the images first.")
    if image_scale(image, width, height) is None:
        raise CaptureError(
            f"is {width}x{height} px, the image {image.name} has {named_size(image)}",
            file=file,
            field="image_size",
            remedy="Give the images for which the cameras were made.",
        )
    k1, k2, k3 = entry.radial_distortion
    p1, p2 = entry.tangential_distortion
    pinhole = (entry.focal_length, entry.focal_length * entry.pixel_aspect_ratio, *entry.principal_point)
    params = (*pinhole, k1, k2, p1, p2, k3, 0.0, 0.0, 0.0)
    return ColmapCamera("FULL_OPENCV", width, height, params).scaled(image.width, image.height)


def _world_to_camera(entry: CameraEntry, file: str) -> np.ndarray:
    rotation = np.array(entry.orientation)
    left, scales, right = np.linalg.svd(rotation)
    if np.abs(scales - 1.0).max() > RIGID_TOLERANCE or np.linalg.det(rotation) < 0:
        raise CaptureError("is no rotation", file=file, field="orientation", remedy="Export the camera again.")
    pose = np.eye(4)
    pose[:3, :3] = left @ right
    pose[:3, 3] = -pose[:3, :3] @ np.array(entry.position)
    return pose
