"""Which captures load, and the error messages of those that do not.

    python benchmarks/captures.py CAPTURE [CAPTURE ...]

Loads each given capture and decodes one image of it; then writes a small synthetic capture, damages copies of it in
a dozen ways and prints the error message of each. Fails if a damaged one loads.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from graings.capture.capture import SPLITS
from graings.capture.images import ImageStore
from graings.capture.load import load_capture
from graings.capture.synthetic import write_synthetic
from graings.errors import CaptureError

TRAIN = "transforms_train.json"


def frames(change: Callable[[list[dict[str, Any]]], Any]) -> Callable[[Path], None]:
    """A break that edits the list of training frames."""

    def apply(folder: Path) -> None:
        document = json.loads((folder / TRAIN).read_text())
        change(document["frames"])
        (folder / TRAIN).write_text(json.dumps(document))

    return apply


def first_image(folder: Path) -> Path:
    return sorted((folder / "train").iterdir())[0]


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def replace_by_text(path: Path) -> None:
    path.write_text("hello")


def without_transforms(folder: Path) -> None:
    for document in folder.glob("*.json"):
        document.unlink()


def without_angle(folder: Path) -> None:
    document = json.loads((folder / TRAIN).read_text())
    for key in [key for key in document if key != "frames"]:
        del document[key]
    (folder / TRAIN).write_text(json.dumps(document))


def scale_rotation(listed: list[dict[str, Any]]) -> None:
    pose = listed[1]["transform_matrix"]
    listed[1]["transform_matrix"] = [[2 * value for value in row[:3]] + row[3:] for row in pose[:3]] + pose[3:]


BREAKS: dict[str, Callable[[Path], None]] = {
    "image missing": lambda folder: first_image(folder).unlink(),
    "image truncated": lambda folder: truncate(first_image(folder)),
    "image is text": lambda folder: replace_by_text(first_image(folder)),
    "json truncated": lambda folder: truncate(folder / TRAIN),
    "no field of view": without_angle,
    "no transform_matrix": frames(lambda listed: listed[0].pop("transform_matrix")),
    "pose not finite": frames(lambda listed: listed[0]["transform_matrix"][0].__setitem__(3, float("inf"))),
    "pose scaled": frames(scale_rotation),
    "time not finite": frames(lambda listed: listed[2].__setitem__("time", float("nan"))),
    "time missing in one frame": frames(lambda listed: listed[2].pop("time")),
    "no frames": frames(lambda listed: listed.clear()),
    "frame listed twice": frames(lambda listed: listed.append(listed[0])),
    "path escapes": frames(lambda listed: listed[0].__setitem__("file_path", "../../etc/passwd")),
    "not a capture": without_transforms,
}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("captures", nargs="*", type=Path)
    print("| capture | result |\n|---|---|")
    for path in parser.parse_args().captures:
        name = "/".join(path.parts[-2:])
        try:
            capture = load_capture(path)
            images = ImageStore((1.0, 1.0, 1.0), 64)
            shape = images.rgb(capture.train[0]).shape
        except CaptureError as error:
            print(f"| {name} | refused: {error} |")
            continue
        counts = "/".join(str(len(capture.split(split))) for split in SPLITS)
        notes = "; ".join(capture.notes) or "no notes"
        print(f"| {name} | loads: {counts} frames, {len(capture.times)} times, {shape[1]}x{shape[0]} px; {notes} |")
    loaded = []
    with tempfile.TemporaryDirectory() as scratch:
        good = write_synthetic(Path(scratch) / "good", frames=6, size=32, bodies=1)
        load_capture(good)
        for name, damage in BREAKS.items():
            bad = Path(scratch) / "broken"
            shutil.copytree(good, bad)
            damage(bad)
            try:
                load_capture(bad)
                loaded.append(name)
                print(f"| broken: {name} | LOADED |")
            except CaptureError as error:
                print(f"| broken: {name} | refused: {str(error).replace(scratch, '')} |")
            shutil.rmtree(bad)
    return 1 if loaded else 0


if __name__ == "__main__":
    sys.exit(main())
