"""FootageReport: what became of a video or of photographs on the way to a capture, as a document and as text."""

from __future__ import annotations

from typing import Final, Literal

from pydantic import Field

from graings.document import Document

REPORT_FILE: Final = "footage.json"
MAX_NAMES: Final = 5


class FootageCamera(Document):
    """The camera that was found, before lens distortion was removed."""

    width: int = Field(gt=0, description="Width of the frames in px.")
    height: int = Field(gt=0, description="Height of the frames in px.")
    focal: float = Field(gt=0, description="Focal length in px.")
    field_of_view: float = Field(gt=0, lt=180, description="Horizontal field of view in degrees.")
    distortion: float = Field(description="Coefficient k of the radial distortion 1 + k r^2.")


class FootageReport(Document):
    """What was found in the footage."""

    schema_name: Literal["graings.footage/1"] = Field("graings.footage/1", alias="schema", description="Format.")
    source: str = Field(description="File or folder name of the source.")
    seen: int = Field(ge=0, description="Frames or photographs in the source.")
    taken: int = Field(ge=0, description="Frames that were matched.")
    registered: int = Field(ge=0, description="Frames whose camera was found: the images of the capture.")
    left_out: tuple[str, ...] = Field(description="Frames that were matched and whose camera was not found.")
    blurred: tuple[str, ...] = Field(description="Frames that were left out because their neighbours are sharper.")
    points: int = Field(ge=0, description="Points seen in three or more frames.")
    reprojection_error: float = Field(ge=0, description="Mean distance of a point's projection from its feature, px.")
    track_length: float = Field(ge=0, description="Mean number of frames that see a point.")
    parallax: float = Field(ge=0, description="Median over the points of the widest angle between their rays, degrees.")
    path_over_depth: float = Field(ge=0, description="Length of the camera's path over the median depth of the points.")
    duration: float = Field(ge=0, description="Seconds between the first and the last image; 0 for a static capture.")
    camera: FootageCamera = Field(description="The camera of all frames, or of most where they have several sizes.")
    notes: tuple[str, ...] = Field((), description="What was assumed, in plain words.")
    seconds: dict[str, float] = Field(description="Wall-clock seconds per phase.")


def lines(report: FootageReport) -> list[str]:
    """The report as lines of text."""
    camera = report.camera
    total = sum(report.seconds.values())
    text = [
        f"{report.registered} of {report.taken} frames have a camera ({report.seen} in the source); "
        f"{report.points:,} points, {report.reprojection_error:.2f} px from their features, "
        f"seen in {report.track_length:.1f} frames on average",
        f"camera: {camera.width} x {camera.height} px, {camera.field_of_view:.0f} degrees wide, "
        f"distortion {camera.distortion:+.3f}; its path is {report.path_over_depth:.1f} times the depth of the scene, "
        f"points are seen over {report.parallax:.0f} degrees",
        f"{total:.0f} s: " + ", ".join(f"{name} {seconds:.0f}" for name, seconds in report.seconds.items()),
    ]
    if report.left_out:
        text.append(f"without a camera: {_names(report.left_out)}")
    if report.blurred:
        text.append(f"blurred and left out: {_names(report.blurred)}")
    return [*text, *(f"note: {note}" for note in report.notes)]


def _names(names: tuple[str, ...]) -> str:
    shown = ", ".join(names[:MAX_NAMES])
    return shown if len(names) <= MAX_NAMES else f"{shown} and {len(names) - MAX_NAMES} more"
