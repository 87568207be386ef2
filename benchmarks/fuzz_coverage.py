"""Inputs that libFuzzer finds by coverage, for the readers that are ours (atheris; the others are libraries in C++).

    pip install atheris; python benchmarks/fuzz_coverage.py FOLDER -max_total_time=600

FOLDER keeps the corpus; it begins with the seeds of benchmarks/fuzz.py. The first byte of an input says which reader
gets the rest. Whatever is raised that is not an error class of ours ends the run and writes the input to the working
directory.
"""

from __future__ import annotations

import sys
import tempfile
import warnings
from contextlib import suppress
from pathlib import Path

import atheris

with atheris.instrument_imports(include=["graings.capture", "service.archives"]):
    from fuzzing.kinds import KINDS

    from graings.errors import GraingsError
    from service.problems import ServiceError

INPUTS = [
    (KINDS[kind], name)
    for kind, name in (
        *(("ply", "points.ply"), ("archives", "archive"), ("arrays", "llff/poses_bounds.npy")),
        *(("colmap", f"colmap/sparse/0/{part}.bin") for part in ("cameras", "images", "points3D")),
        *(("colmap", f"colmap-text/sparse/0/{part}.txt") for part in ("cameras", "images", "points3D")),
        *(("json", "single/transforms.json"), ("json", "nerfies/dataset.json"), ("images", "image0.png")),
    )
]


def main() -> None:
    warnings.simplefilter("ignore")
    corpus = Path(sys.argv[1])
    corpus.mkdir(parents=True, exist_ok=True)
    folder = Path(tempfile.mkdtemp(prefix="graings-fuzz-"))
    places = {}
    for number, (kind, name) in enumerate(INPUTS):
        if kind.name not in places:
            (folder / kind.name).mkdir()
            places[kind.name] = kind.open(folder / kind.name)
        for index, (seed, data) in enumerate(kind.valid()):
            if seed == name:
                (corpus / f"seed-{number}-{index}").write_bytes(bytes([number]) + data)

    def read(data: bytes) -> None:
        if not data:
            return
        kind, name = INPUTS[data[0] % len(INPUTS)]
        with suppress(GraingsError, ServiceError):
            kind.read(places[kind.name], name, data[1:])

    atheris.Setup([*sys.argv, "-rss_limit_mb=4096", "-timeout=20", "-max_len=20000"], read)
    atheris.Fuzz()


if __name__ == "__main__":
    main()
