"""Export: a model at one time as a file of splats, or at several times as an archive of PLY files."""

from __future__ import annotations

import io
import json
import zipfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, Literal

from pydantic import Field

from graings.document import Document
from graings.export.formats import WRITERS, suffix_of
from graings.export.four_d import four_d_file
from graings.export.harmonics_fit import fit_splats
from graings.export.selection import Selection
from graings.render import PreparedScene
from graings.scene.splats import Splats
from graings.storage.model import Model

SEQUENCE: Final = "zip"
MODEL: Final = "graings"
SCENE: Final = "scene.gz"  # for the player (graings.player)
PAGE: Final = "html"  # the player with its scene
WHOLE: Final = (MODEL, SCENE, PAGE)  # formats with all times, which have no splats to choose
FOUR_D: Final = "4dgs"
SEVERAL: Final = (SEQUENCE, FOUR_D)  # formats with several times
FORMATS: Final = (*WRITERS, *SEVERAL)
PLAIN: Final = "splat"  # its colours do not depend on the view
FRAMES: Final = 30
MAX_FRAMES: Final = 10_000


class SequenceFrame(Document):
    """One file of a sequence."""

    file: str = Field(description="A PLY file of 3D Gaussian Splatting, in the capture's coordinates.")
    t: float = Field(ge=0, le=1, description="Time, 0 the beginning and 1 the end of the capture.")
    capture_time: float = Field(description="The same in the capture's own units of time.")
    splats: int = Field(ge=1, description="Number of splats.")


class SequenceManifest(Document):
    """`manifest.json` of an archive of PLY files."""

    schema_name: Literal["graings.ply_sequence/1"] = Field(
        "graings.ply_sequence/1", alias="schema", description="Kind and version of this document."
    )
    up: tuple[float, float, float] = Field(description="The capture's vertical axis, unit length.")
    degree: int = Field(ge=0, le=3, description="Highest degree of the spherical harmonics.")
    frames: tuple[SequenceFrame, ...] = Field(description="The files, in order of time.")


@dataclass(frozen=True, slots=True)
class ExportRequest:
    """What to export: the time in [0, 1], or for `zip` and `4dgs` the number of `frames` evenly over it.

    `degree` of the harmonics: 0 to 3, for `splat` 0, or None for what the scene and the format need. Raises
    `ValueError` for values out of range.
    """

    format: str
    time: float = 0.0
    frames: int = FRAMES
    degree: int | None = None
    selection: Selection = field(default_factory=Selection)

    def __post_init__(self) -> None:
        if self.format not in FORMATS:
            raise ValueError(f"format {self.format!r} is not written, choose one of {', '.join(FORMATS)}")
        if not 0 <= self.time <= 1:
            raise ValueError(f"time must lie in [0, 1], got {self.time}")
        if not 1 <= self.frames <= MAX_FRAMES:
            raise ValueError(f"frames must lie in [1, {MAX_FRAMES}], got {self.frames}")
        if self.degree is not None and not 0 <= self.degree <= 3:
            raise ValueError(f"degree must lie in [0, 3], got {self.degree}")
        if self.format == PLAIN and self.degree:
            raise ValueError(f"degree must be 0 for a .{PLAIN} file, whose colours do not depend on the view")


@dataclass(frozen=True, slots=True, eq=False)
class Exported:
    """The file and what is in it."""

    data: bytes
    splats: int  # of all frames together
    dropped: int
    degree: int


def export_format(path: Path) -> str:
    """The format that the name of `path` asks for. Raises `ValueError` with the list of those that are written."""
    found = suffix_of(path, (*FORMATS, *WHOLE))
    if found is None:
        known = ", ".join(f".{name}" for name in (*FORMATS, *WHOLE))
        raise ValueError(f"{path.name}: files of this kind are not written, choose one of {known}")
    return found


def check_used(format: str, *, time: float | None = None, frames: int | None = None, degree: int | None = None) -> None:
    """Raises `ValueError` for the first value that is given, so not None, and that `format` does not use."""
    single = format in WRITERS
    for name, value, used in (
        ("a time", time, single),
        ("a number of frames", frames, format in SEVERAL),
        ("a degree", degree, single or format in SEVERAL),
    ):
        if value is not None and not used:
            content = "one time" if single else "several times" if format in SEVERAL else "the whole scene"
            raise ValueError(f"{name} is not used by a .{format} file, which holds {content}; leave it out")


def export_splats(model: Model, request: ExportRequest) -> Exported:
    """`model` in the format of `request`.

    Raises `ValueError` where nothing is left and where the format cannot hold the splats, and `CheckpointError`.
    """
    scene = PreparedScene(model.scene)
    if request.format == FOUR_D:
        found = four_d_file(model, request.frames, request.degree, request.selection)
        return Exported(found.data, found.records, found.dropped, found.degree)
    if request.format != SEQUENCE:
        # The constant of a fit with higher degrees is not the best constant: jumpingjacks loses 2.9 dB by it.
        degree = 0 if request.format == PLAIN else request.degree
        splats, dropped = _splats(model, scene, request, request.time, degree)
        return Exported(WRITERS[request.format](splats, model.units), len(splats), dropped, splats.degree)
    degree, dropped, frames = request.degree, 0, []
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as files:
        for index in range(request.frames):
            time = index / max(1, request.frames - 1)
            splats, without = _splats(model, scene, request, time, degree)
            degree, dropped = splats.degree, dropped + without  # one degree for all frames
            name = f"{index:05d}.ply"
            files.writestr(name, WRITERS["ply"](splats, model.units))
            moment = model.units.time_start + time * model.units.time_span
            frames.append(SequenceFrame(file=name, t=time, capture_time=moment, splats=len(splats)))
        manifest = SequenceManifest(up=model.units.up, degree=degree or 0, frames=tuple(frames))
        files.writestr("manifest.json", json.dumps(manifest.to_json(), indent=2))
    return Exported(archive.getvalue(), sum(frame.splats for frame in frames), dropped, degree or 0)


def _splats(
    model: Model, scene: PreparedScene, request: ExportRequest, time: float, degree: int | None
) -> tuple[Splats, int]:
    """The splats at `time` that are kept, and how many are not."""
    fit = fit_splats(scene, [view.camera for view in model.views["train"]], time, degree=degree)
    kept = request.selection.kept(fit, model.units)
    if not bool(kept.any()):
        raise ValueError(f"no splat of {len(kept)} is left at t = {time:g}: widen the box or the sphere")
    return fit.splats.rows(kept), int((~kept).sum())
