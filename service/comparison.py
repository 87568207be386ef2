"""Comparison: a photograph of a capture, the model from the same camera, and their difference."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from anyio import to_thread
from numpy.typing import NDArray

from graings.camera.viewpoint import named_view
from graings.capture.images import ImageStore
from graings.capture.load import load_capture
from graings.config import CaptureConfig
from graings.errors import CaptureError
from graings.evaluation.metrics import Pair, measure
from graings.image_encoding import encode_image
from graings.render import render
from service.inspection import apart, defect
from service.problems import BadRequest
from service.rendering import LoadedModel

GAIN: Final = 5.0  # differences are shown so many times larger


@dataclass(frozen=True, slots=True)
class Comparison:
    """Photograph, model and difference side by side as PNG, and the PSNR of the model in dB."""

    image: bytes
    psnr: float


async def compare(capture: Path, loaded: LoadedModel, camera: str) -> Comparison:
    """The view `camera` (`val:0`) of the capture against the model.

    Raises `BadRequest` for a view that there is not, and `CaptureError` where the photograph cannot be read.
    """
    model = loaded.model
    try:
        view = named_view(model.views, camera)
    except ValueError as error:
        raise BadRequest(f"{error}.") from error
    split = camera.partition(":")[0]
    # An uploaded image is decoded in another process, as when it came.
    photo, valid = await apart(_photograph, capture, model.config.capture, split, view.name, model.background)

    def compared() -> Comparison:
        drawn = render(loaded.scene, view.camera, view.time, model.background).color.clamp(0, 1).numpy()
        found = measure(Pair(view.name, view.time, drawn, photo, valid))
        difference = np.clip(GAIN * np.abs(drawn - photo), 0, 1)
        if valid is not None:
            difference[~valid] = 0
        return Comparison(encode_image(np.concatenate([photo, drawn, difference], axis=1), "png"), found.psnr)

    return await to_thread.run_sync(compared)


def _photograph(
    root: Path, config: CaptureConfig, split: str, name: str, background: tuple[float, float, float]
) -> Any:
    """The photograph [H, W, 3] on `background` and its valid pixels, or a defect."""
    try:
        frames: Any = load_capture(root, config).split(split)  # type: ignore[arg-type]
        frame = next((frame for frame in frames if frame.name == name), None)
        if frame is None:
            raise CaptureError("is not in the capture any more", file=name, remedy="Submit the capture again.")
        images = ImageStore(background, cache_mb=1)
        photo: NDArray[np.float32] = images.rgb(frame)
        return photo, images.valid(frame)
    except CaptureError as error:
        return defect(root, error)
