"""make_capture: a capture from a video or a folder of photographs without poses.

Frames, camera poses, undistorted images and first points, in the single-file layout of nerfstudio. What is done so far
lies in `.footage` of the capture's folder: a call that was interrupted continues there, and one that asks for other
frames begins again. Nothing else in that folder is replaced or removed.
"""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from graings.capture.load import holds_capture
from graings.colmap import import_pycolmap
from graings.document import read_document
from graings.errors import CaptureError
from graings.footage.frame_document import FootageFrames, FrameRequest
from graings.footage.photos import convert_photographs, photographs
from graings.footage.placement import check_free, is_finished, place, take_back
from graings.footage.poses import reconstruct
from graings.footage.registration import MIN_TRACK, check_usable, measure, nothing_registered, upright
from graings.footage.report import REPORT_FILE, FootageReport
from graings.footage.sharpness import blurred
from graings.footage.source import find_footage
from graings.footage.video import extract_frames
from graings.storage.files import write_document, write_json
from graings.storage.locks import locked

if TYPE_CHECKING:
    import pycolmap

WORKSPACE: Final = ".footage"
LOCK_FILE: Final = ".lock"
TRANSFORMS: Final = "transforms.json"
POINTS: Final = "points.ply"
IMAGES: Final = "images"

# In the order in which they are put into the capture's folder: with the last one the capture is complete.
CAPTURE_FILES: Final = (IMAGES, POINTS, REPORT_FILE, TRANSFORMS)

# Where they are made, without and with `static`: a finished capture has times or has none.
MADE: Final = ("moving", "static")

Observe = Callable[[str, int, int], None]


def make_capture(
    source: Path,
    target: Path,
    *,
    frames: int = 100,
    max_side: int = 1000,
    static: bool = False,
    threads: int = 1,
    observe: Observe = lambda phase, done, total: None,
) -> FootageReport:
    """Write the capture of `source` to the folder `target` and return what was found.

    Of a video at most `frames` frames are taken, of a folder all photographs, or those of its only folder; images have
    no side above `max_side` px. A `static` capture has no times. `observe` is called with the phase, what is done of it
    and its total. Raises `CaptureError` where the source cannot be read, where its frames do not fit together, and for
    a `target` that holds a capture or files in the places of one, that was begun with another source, or that is being
    written by another process.
    """
    if not source.exists():
        raise CaptureError("does not exist", file=source, remedy="Give a video or a folder of photographs.")
    if source.is_dir() and not photographs(source):
        source = find_footage(source) or source  # as the service does: the folder of a folder, or of a lone video
    workspace = target / WORKSPACE
    made = workspace / MADE[static]
    _check_target(source, target, made)
    seconds: dict[str, float] = {}
    observe = _timed(observe, seconds)
    workspace.mkdir(parents=True, exist_ok=True)
    with _sole(workspace):
        taken = _frames(source, workspace, _request(source, frames, max_side), observe)
        check_free(made, target, CAPTURE_FILES)  # again, as other frames begin without what was finished
        if not is_finished(made, CAPTURE_FILES):
            _make(source, workspace, made, taken, static, threads, observe, seconds)
        place(made, target, CAPTURE_FILES)
        shutil.rmtree(workspace)
    return read_document(target / REPORT_FILE, FootageReport, "Make the capture again.")


def _check_target(source: Path, target: Path, made: Path) -> None:
    """Raise `CaptureError` where the capture would be written over files, or among those it is made of."""
    if target.exists() and not target.is_dir():
        raise CaptureError("is a file, not a folder", file=target, remedy="Choose another folder.")
    if target.is_dir() and holds_capture(target):
        raise CaptureError("holds a capture already", file=target, remedy="Choose another folder.")
    workspace, there = target / WORKSPACE, source.resolve()
    if workspace.exists() and any(workspace.iterdir()) and not (workspace / LOCK_FILE).exists():
        problem = "is not the workspace of an earlier call"
        raise CaptureError(problem, file=workspace, remedy="Choose another folder for the capture, or move it away.")
    written = [path.resolve() for path in (target / IMAGES, workspace)]
    if there == target.resolve() or any(there.is_relative_to(path) for path in written):
        problem = f"lies where the capture {target} would be written"
        raise CaptureError(problem, file=source, remedy="Choose another folder for the capture.")
    check_free(made, target, CAPTURE_FILES)


def _make(
    source: Path,
    workspace: Path,
    made: Path,
    taken: FootageFrames,
    static: bool,
    threads: int,
    observe: Observe,
    seconds: dict[str, float],
) -> None:
    """Write the files of the capture to the folder `made`; `seconds` of each phase are those of `observe`."""
    names = [frame.name for frame in taken.frames]
    model = reconstruct(workspace / "frames", names, workspace, threads, observe)
    if model is None:
        raise nothing_registered(len(names), source)
    found = measure(model)
    check_usable(found, len(names), source)
    observe("undistortion", 0, 1)
    times = {} if static else {frame.name: frame.time for frame in taken.frames}
    shutil.rmtree(made, ignore_errors=True)
    made.mkdir()
    transforms = _write_images_and_points(model, workspace, made, times)
    observe("undistortion", 1, 1)
    registered = [times[name] for name in found.names if name in times]
    report = FootageReport(
        source=taken.request.source,
        seen=taken.seen,
        taken=len(names),
        registered=len(found.names),
        left_out=tuple(sorted(set(names) - set(found.names))),
        blurred=taken.blurred,
        points=found.points,
        reprojection_error=found.reprojection_error,
        track_length=found.track_length,
        parallax=found.parallax,
        path_over_depth=found.path_over_depth,
        duration=max(registered) - min(registered) if registered else 0.0,
        camera=found.camera,
        notes=(*taken.notes, *found.notes()),
        seconds=seconds,
    )
    write_document(made / REPORT_FILE, report)
    write_json(made / TRANSFORMS, transforms)


def _timed(observe: Observe, seconds: dict[str, float]) -> Observe:
    """`observe`, which also adds the seconds since the last call to the phase."""
    last = time.perf_counter()

    def note(phase: str, done: int, total: int) -> None:
        nonlocal last
        now = time.perf_counter()
        seconds[phase] = seconds.get(phase, 0.0) + now - last
        last = now
        observe(phase, done, total)

    return note


def _frames(source: Path, workspace: Path, request: FrameRequest, observe: Observe) -> FootageFrames:
    """The frames in the workspace: those of an earlier call that asked for the same, or new ones."""
    record = workspace / "frames.json"
    if record.exists():
        known = read_document(record, FootageFrames, f"Delete {workspace} to begin again.")
        if known.request.source != request.source:
            remedy = f"Give that one, or delete {workspace}."
            problem = f"was begun with {known.request.source}, not {request.source}"
            raise CaptureError(problem, file=workspace, remedy=remedy)
        if known.request == request:
            return known
    for made in MADE:
        take_back(workspace / made, workspace.parent, CAPTURE_FILES)
    # Features and matches of other frames would be taken for those of the new ones.
    for content in workspace.iterdir():
        if content.name != LOCK_FILE:
            shutil.rmtree(content) if content.is_dir() else content.unlink()
    target = workspace / "frames"
    target.mkdir()
    blurry, notes = tuple[str, ...](), tuple[str, ...]()
    if source.is_dir():
        photos = photographs(source)
        if not photos:
            raise CaptureError("holds no photographs", file=source, remedy="Give a video or a folder of photographs.")
        seen = len(photos)
        frames, notes = convert_photographs(photos, target, request.max_side, lambda d, n: observe("frames", d, n))
    else:
        side, count = request.max_side, request.count
        seen, frames = extract_frames(source, target, count, side, lambda d, n: observe("frames", d, n))
        # Neighbours of a video show the same: who is less sharp is blurred. Photographs may show anything.
        unsharp = blurred([frame.sharpness for frame in frames])
        blurry = tuple(frame.name for frame, out in zip(frames, unsharp, strict=True) if out)
    kept = tuple(frame for frame in frames if frame.name not in blurry)
    document = FootageFrames(request=request, seen=seen, frames=kept, blurred=blurry, notes=notes)
    write_document(record, document)
    return document


def _request(source: Path, count: int, max_side: int) -> FrameRequest:
    files = [(path.name, path.stat()) for path in (photographs(source) if source.is_dir() else [source])]
    listed = tuple((name, stat.st_size, stat.st_mtime_ns) for name, stat in files)
    return FrameRequest(source=source.name, files=listed, count=count, max_side=max_side)


@contextmanager
def _sole(workspace: Path) -> Iterator[None]:
    """Lock a workspace for one call. Raises `CaptureError` when another process of this machine has the lock."""
    with locked(workspace / LOCK_FILE, wait=False) as free:
        if not free:
            remedy = "Wait for it, or choose another folder."
            raise CaptureError("is being written by another process", file=workspace.parent, remedy=remedy)
        yield


def _write_images_and_points(
    model: pycolmap.Reconstruction, workspace: Path, made: Path, times: dict[str, float]
) -> dict[str, Any]:
    """Write undistorted images and points to the folder `made`; returns the transforms file with their cameras."""
    pycolmap = import_pycolmap()
    rotation = pycolmap.Rotation3d(upright(model))
    model.transform(pycolmap.Sim3d(1.0, rotation, np.zeros(3)))
    best, undistorted = workspace / "best", workspace / "undistorted"
    best.mkdir(exist_ok=True)
    model.write(best)
    shutil.rmtree(undistorted, ignore_errors=True)
    pycolmap.undistort_images(undistorted, best, workspace / "frames")
    pinhole = pycolmap.Reconstruction(undistorted / "sparse")
    for key, point in list(pinhole.points3D.items()):
        if point.track.length() < MIN_TRACK:
            pinhole.delete_point3D(key)
    pinhole.export_PLY(made / POINTS)
    (undistorted / "images").rename(made / IMAGES)
    images = sorted((pinhole.image(key) for key in pinhole.reg_image_ids()), key=lambda image: image.name)
    return {
        "camera_model": "PINHOLE",
        "ply_file_path": POINTS,
        "frames": [_frame(image, pinhole.camera(image.camera_id), times.get(image.name)) for image in images],
    }


def _frame(image: pycolmap.Image, camera: pycolmap.Camera, moment: float | None) -> dict[str, Any]:
    """The entry of one image: intrinsics in px, camera-to-world with OpenGL axes, time in seconds."""
    world_from_camera = np.eye(4)
    world_from_camera[:3] = image.cam_from_world().inverse().matrix()
    world_from_camera[:, 1:3] *= -1  # OpenCV's y down, z forward to OpenGL's y up, z back
    return {
        "file_path": f"{IMAGES}/{image.name}",
        "fl_x": camera.focal_length_x,
        "fl_y": camera.focal_length_y,
        "cx": camera.principal_point_x,
        "cy": camera.principal_point_y,
        "w": camera.width,
        "h": camera.height,
        "transform_matrix": world_from_camera.tolist(),
        **({} if moment is None else {"time": moment}),
    }
