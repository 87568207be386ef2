"""FootageFrames: which frames of a video or photographs were taken, and when each was recorded."""

from __future__ import annotations

from pydantic import Field

from graings.document import Document


class FootageFrame(Document):
    """One frame that was taken."""

    name: str = Field(description="File name of its image.")
    time: float = Field(description="Seconds since the first frame; of photographs without times their number.")
    sharpness: float = Field(ge=0, description="Mean absolute Laplacian of the luma, 0 to 255, at 480 px width.")


class FrameRequest(Document):
    """Which frames of which source: an interrupted call continues only where it asks for the same."""

    source: str = Field(description="File or folder name of the source.")
    files: tuple[tuple[str, int, int], ...] = Field(description="Name, bytes and time of change in ns of each file.")
    count: int = Field(gt=0, description="Greatest number of frames of a video.")
    max_side: int = Field(gt=0, description="Greatest side of the images in px.")


class FootageFrames(Document):
    """The frames of one source."""

    request: FrameRequest = Field(description="What was asked for.")
    seen: int = Field(ge=0, description="Frames or photographs in the source.")
    frames: tuple[FootageFrame, ...] = Field(description="Frames that were taken, in order of time.")
    blurred: tuple[str, ...] = Field((), description="Frames that were left out because their neighbours are sharper.")
    notes: tuple[str, ...] = Field((), description="What was assumed about the source, in plain words.")
