"""PixelLimit: how many pixels the large images at work have together, so that a few of them cannot fill the memory."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

from graings.camera.view_request import MAX_SIDE
from service.problems import Busy

# An image of at most so many pixels counts nothing: the number of images at a time is limited anyway, and a large one
# must not keep the small ones away.
LARGE: Final = 2_048 * 2_048
MAX_PIXELS: Final = MAX_SIDE * MAX_SIDE  # one image of the greatest size


class PixelLimit:
    """Used on one event loop."""

    def __init__(self) -> None:
        self._held = 0

    @contextmanager
    def held(self, pixels: int) -> Iterator[None]:
        """While an image of so many pixels is rendered and sent. Raises `Busy`."""
        counted = pixels if pixels > LARGE else 0
        if self._held + counted > MAX_PIXELS:
            raise Busy("Other large images are being rendered. Try again in a moment, or ask for a smaller one.")
        self._held += counted
        try:
            yield
        finally:
            self._held -= counted
