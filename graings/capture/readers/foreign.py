"""Formats that are recognised and not read, with the way in."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

from graings.capture.image_file import SUFFIXES, UNREADABLE_SUFFIXES
from graings.capture.readers.rig import VIDEO_SUFFIXES

# Suffixes of files by which such formats are recognised, beside those of captures.
MARKER_SUFFIXES: Final = (".xml", ".csv", ".sfm", ".out", ".geojson")


@dataclass(frozen=True, slots=True)
class Foreign:
    """A format: `patterns` of files one of which it has, its name, and what to do."""

    patterns: tuple[str, ...]
    name: str
    way_in: str


_PROCESS: Final = "convert it with nerfstudio's `ns-process-data {}` and give its output"
_FOOTAGE: Final = "find the cameras first: `graings capture {} -o CAPTURE`, then give that folder"

FORMATS: Final = (
    Foreign(("opensfm/reconstruction.json", "odm_*", "images.json"), "OpenDroneMap", _PROCESS.format("odm")),
    Foreign(("reconstruction.json",), "OpenSfM", "export it with `opensfm export_colmap` and give that folder"),
    Foreign(
        ("*.psx", "cameras.xml", "*.xml"),
        "Agisoft Metashape",
        "export the cameras as COLMAP (File, Export, Export Cameras), or " + _PROCESS.format("metashape"),
    ),
    Foreign(("*.csv",), "RealityCapture", "export the registration as COLMAP, or " + _PROCESS.format("realitycapture")),
    Foreign(("keyframes/corrected_cameras", "keyframes/cameras"), "Polycam", _PROCESS.format("polycam")),
    Foreign(("EXR_RGBD",), "Record3D", _PROCESS.format("record3d")),
    Foreign(("*.sfm", "cameras.sfm"), "Meshroom", "export the cameras as COLMAP with the node ExportColmap"),
    Foreign(("bundle.out", "*.out"), "Bundler", "import it into COLMAP, for example with its model_converter"),
    Foreign(
        ("point_cloud/iteration_*",), "a trained 3D Gaussian Splatting model", "give the capture it was trained on"
    ),
    Foreign(tuple(f"*{suffix}" for suffix in VIDEO_SUFFIXES), "video without cameras", _FOOTAGE.format("VIDEO")),
    Foreign(
        tuple(f"{place}*{suffix}" for place in ("", "images/", "*/") for suffix in (*SUFFIXES, *UNREADABLE_SUFFIXES)),
        "pictures without cameras",
        _FOOTAGE.format("FOLDER"),
    ),
)


def recognised(root: Path) -> Foreign | None:
    """The first of `FORMATS` whose files lie in the folder `root`."""
    return next((each for each in FORMATS if any(True for p in each.patterns for _ in root.glob(p))), None)
