"""Pictures, videos and exports of a model in a program: a part of the Python interface, `graings.api`."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from graings.api.training import FilePath
from graings.camera.view_request import ViewRequest
from graings.export.camera_path import Moves, frames_of
from graings.export.selection import Selection
from graings.export.shown import Shown, open_shown
from graings.export.video import check_video, write_video
from graings.image_encoding import encode_image, image_format
from graings.player.export_file import export_file, export_request
from graings.render import render
from graings.storage.compact import open_model
from graings.storage.files import write_bytes


def open_scene(path: FilePath) -> Shown:
    """A model, or a file of splats (.ply, .spz, .sog, .ksplat), ready to be rendered many times.

    It has `views`, the cameras of the capture by split, `units` and `background`. Raises `CheckpointError`.
    """
    return open_shown(Path(path))


def render_view(scene: Shown, **view: Any) -> NDArray[np.float32]:
    """The colours [H, W, 3] of one view, in [0, 1].

    `view` has the parameters of `graings render`: `t`, and `camera` ("test:3"), an orbit (`azimuth`, `elevation`,
    `radius`, `target`, `fov`) or a `pose`; `width`, `height`, `background`. Raises `ValueError` naming the parameter.
    """
    camera, time, background = _request(view).resolve(scene.views, scene.units, scene.background)
    return render(scene.scene, camera, time, background).color.clamp(0.0, 1.0).numpy()


def save_image(path: FilePath, image: ArrayLike) -> None:
    """Write an image [H, W, 1, 3 or 4] with values in [0, 1] as .png, .jpg, .webp or .exr.

    Raises `ValueError` for another shape or suffix.
    """
    path = Path(path)
    write_bytes(path, encode_image(image, image_format(path.suffix)))


def render_video(
    scene: Shown,
    path: FilePath,
    *,
    seconds: float = 4.0,
    fps: float = 30.0,
    moves: Moves = "both",
    along: str | None = None,
    observe: Callable[[int], None] = lambda done: None,
    **view: Any,
) -> None:
    """Write a video: .mp4, .webm, .webp, .gif, or without suffix a folder of PNG files.

    `moves`: "time", "camera" or "both". `along`: "orbit", "views" (a spline through training views), or the name of a
    file with a camera path; None is "orbit", or "views" if all training views are on one side. `view`: as for
    `render_view`. Raises `ValueError`, and `CheckpointError` for the file.
    """
    path, request = Path(path), _request(view)
    check_video(path, fps)
    _, _, background = request.resolve(scene.views, scene.units, scene.background)
    frames = frames_of(scene, request, along, moves, max(1, round(seconds * fps)))
    write_video(path, scene, frames, background, fps=fps, observe=observe)


def export_model(
    run: FilePath,
    path: FilePath,
    *,
    t: float | None = None,
    frames: int | None = None,
    degree: int | None = None,
    box: Sequence[float] | None = None,
    sphere: Sequence[float] | None = None,
    seen: bool = False,
) -> str:
    """Write a model in the format that the suffix of `path` names; returns a line on its size and content.

    With all times: .graings, .html, .scene.gz. At the time `t` (default 0): .ply, .compressed.ply, .spz, .sog, .splat,
    .glb. At `frames` times (default 30): .zip, .4dgs. `degree`, `box`, `sphere` and `seen`: as for `graings export`.
    Raises `ValueError`, also for what the format does not use, `CheckpointError` for the model and
    `OutputError` for the file.
    """
    selection = Selection(None if box is None else tuple(box), None if sphere is None else tuple(sphere), seen)
    request = export_request(Path(path), time=t, frames=frames, degree=degree, selection=selection)
    return export_file(open_model(Path(run)), Path(path), request)


def _request(view: Mapping[str, Any]) -> ViewRequest:
    try:
        return ViewRequest(**view)
    except TypeError as error:
        known = ", ".join(ViewRequest.__dataclass_fields__)
        raise ValueError(f"a view has the parameters {known}; got {', '.join(view)}") from error
