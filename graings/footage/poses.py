"""Camera poses of frames by structure from motion: pycolmap's SIFT, matching of near frames and loops, global mapping.

Frames of one size share a camera with one radial coefficient. Photographs may have several sizes, as those held upright
and across, and each has a camera of its own. Features and matches lie in a database in the workspace, so an interrupted
call continues. Global mapping solves all poses at once: incremental mapping took as long or longer on the
clips tried, and broke some of them into pieces.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final, TypeVar

from graings.colmap import import_pycolmap, pycolmap_remedy
from graings.errors import CaptureError
from graings.footage.photos import image_size

if TYPE_CHECKING:
    import pycolmap

MAX_FEATURES: Final = 4096
CAMERA_MODEL: Final = "SIMPLE_RADIAL"

# Each frame is matched with so many following ones, with some further ones at growing distance, and every LOOP_PERIODth
# frame with all others of these, so that a camera that comes back closes the loop.
OVERLAP: Final = 5
FAR: Final = (8, 16, 32)
LOOP_PERIOD: Final = 8

NO_CAMERA: Final = -1  # pycolmap then makes one

FEATURES_AT_ONCE: Final = 8
PAIRS_AT_ONCE: Final = 64
SEED: Final = 0

Item = TypeVar("Item")
Observe = Callable[[str, int, int], None]


def reconstruct(
    images: Path, names: Sequence[str], workspace: Path, threads: int, observe: Observe
) -> pycolmap.Reconstruction | None:
    """The reconstruction with the most of the images `names` in the folder `images`; None where nothing fits together.

    `observe` is called with the phase, what is done of it and its total. Raises `CaptureError` without pycolmap.
    """
    try:
        pycolmap = import_pycolmap()
    except ModuleNotFoundError as error:
        what = "finding the cameras needs the package pycolmap"
        raise CaptureError(what, file=images, remedy=f"{pycolmap_remedy()}.") from error
    database = workspace / "database.db"
    _extract(database, images, names, threads, observe)
    _match(database, names, workspace / "pairs.txt", threads, observe)
    observe("mapping", 0, 1)
    options = pycolmap.GlobalPipelineOptions()
    options.num_threads = threads
    options.random_seed = SEED
    sparse = workspace / "sparse"
    sparse.mkdir(exist_ok=True)
    models = pycolmap.global_mapping(database, images, sparse, options).values()
    observe("mapping", 1, 1)
    return max(models, key=lambda model: int(model.num_reg_images()), default=None)


def pairs(count: int) -> list[tuple[int, int]]:
    """The pairs of `count` frames in order of time that are matched."""
    near = ((i, i + d) for i in range(count) for d in (*range(1, OVERLAP + 1), *FAR) if i + d < count)
    loops = itertools.combinations(range(0, count, LOOP_PERIOD), 2)
    return sorted({*near, *loops})


def _extract(database: Path, images: Path, names: Sequence[str], threads: int, observe: Observe) -> None:
    pycolmap = import_pycolmap()
    options = pycolmap.FeatureExtractionOptions()
    options.num_threads = threads
    options.sift.max_num_features = MAX_FEATURES
    options.sift.first_octave = 0  # not doubled first: a third of the time, and as many frames registered
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = CAMERA_MODEL
    sizes = {name: image_size(images / name) for name in names}
    done = 0
    for size in sorted(set(sizes.values())):
        for chunk in _chunks([name for name in names if sizes[name] == size], FEATURES_AT_ONCE):
            reader.existing_camera_id = _cameras(database).get(size, NO_CAMERA)
            pycolmap.extract_features(
                database, images, list(chunk), pycolmap.CameraMode.SINGLE, reader, options, pycolmap.Device.cpu
            )
            done += len(chunk)
            observe("features", done, len(names))


def _cameras(database: Path) -> dict[tuple[int, int], int]:
    """The camera of each size of images that the database has."""
    pycolmap = import_pycolmap()
    with pycolmap.Database.open(database) as content:
        return {(camera.width, camera.height): camera.camera_id for camera in content.read_all_cameras()}


def _match(database: Path, names: Sequence[str], listing: Path, threads: int, observe: Observe) -> None:
    pycolmap = import_pycolmap()
    options = pycolmap.FeatureMatchingOptions()
    options.num_threads = threads
    chosen = pairs(len(names))
    done = 0
    for chunk in _chunks(chosen, PAIRS_AT_ONCE):
        listing.write_text("".join(f"{names[i]} {names[j]}\n" for i, j in chunk))
        pairing = pycolmap.ImportedPairingOptions()
        pairing.match_list_path = listing
        pycolmap.match_image_pairs(database, options, pairing, pycolmap.TwoViewGeometryOptions(), pycolmap.Device.cpu)
        done += len(chunk)
        observe("matching", done, len(chosen))


def _chunks(items: Sequence[Item], size: int) -> Iterator[Sequence[Item]]:
    for start in range(0, len(items), size):
        yield items[start : start + size]
