"""Files of the user: a capture is written beside them, or refused, and never over them."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from graings.errors import CaptureError
from graings.footage import make_capture as module
from graings.footage.make_capture import CAPTURE_FILES, WORKSPACE, make_capture
from graings.image_encoding import encode_image

pycolmap = pytest.importorskip("pycolmap")

COUNT, WIDTH, HEIGHT = 10, 64, 48

Files = dict[str, bytes | str]


def photos(folder: Path) -> Path:
    folder.mkdir(parents=True)
    for index in range(COUNT):
        image = np.random.default_rng(index).random((HEIGHT, WIDTH, 3), dtype=np.float32)
        (folder / f"IMG_{index}.png").write_bytes(encode_image(image))
    return folder


def files(folder: Path) -> Files:
    """The content of every file below `folder`, the target of every link; not what a call keeps for the next."""
    found: Files = {}
    for path in folder.rglob("*"):
        name = path.relative_to(folder).as_posix()
        if path.is_symlink():
            found[name] = str(path.readlink())
        elif path.is_file() and WORKSPACE not in path.parts:
            found[name] = path.read_bytes()
    return found


@pytest.fixture(autouse=True)
def _cameras_are_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """Cameras of a synthetic scene, so that nothing but the target can be the reason of a refusal."""

    def reconstruct(images: Path, names: list[str], *rest: object) -> object:
        options = pycolmap.SyntheticDatasetOptions()
        options.num_rigs = options.num_cameras_per_rig = 1
        options.num_frames_per_rig, options.num_points3D = len(names), 60
        options.camera_width, options.camera_height = WIDTH, HEIGHT
        options.camera_model_id = pycolmap.CameraModelId.SIMPLE_RADIAL
        options.camera_params = [60.0, WIDTH / 2, HEIGHT / 2, 0.01]
        model = pycolmap.synthesize_dataset(options)
        for key, name in zip(sorted(model.reg_image_ids()), names, strict=True):
            model.image(key).name = name
        return model

    monkeypatch.setattr(module, "reconstruct", reconstruct)


def interrupted_while_placing(source: Path, target: Path, monkeypatch: pytest.MonkeyPatch, moved: int) -> None:
    """A call that ends after `moved` of its files were moved to their places."""

    def place(made: Path, folder: Path, names: tuple[str, ...]) -> None:
        for name in names[:moved]:
            (made / name).rename(folder / name)
        raise KeyboardInterrupt

    with monkeypatch.context() as context:
        context.setattr(module, "place", place)
        with pytest.raises(KeyboardInterrupt):
            make_capture(source, target)
    assert {path.name for path in target.iterdir()} == {WORKSPACE, *CAPTURE_FILES[:moved]}


def images_of_the_target(root: Path) -> tuple[Path, Path]:
    return photos(root / "holiday/images"), root / "holiday"


def folder_of_the_images(root: Path) -> tuple[Path, Path]:
    photos(root / "holiday/images")
    return root / "holiday", root / "holiday"


def folder_in_the_images(root: Path) -> tuple[Path, Path]:
    return photos(root / "holiday/images/day1"), root / "holiday"


def the_target_itself(root: Path) -> tuple[Path, Path]:
    return photos(root / "holiday"), root / "holiday"


def through_a_link(root: Path) -> tuple[Path, Path]:
    photos(root / "holiday/images")
    (root / "link").symlink_to("holiday")
    return root / "holiday/images", root / "link"


def link_to_the_photographs(root: Path) -> tuple[Path, Path]:
    photos(root / "photos")
    (root / "c").mkdir()
    (root / "c/images").symlink_to("../photos")
    return root / "photos", root / "c"


def colmap_model_alone(root: Path) -> tuple[Path, Path]:
    (root / "scene/sparse/0").mkdir(parents=True)
    (root / "scene/sparse/0/cameras.txt").write_text("1 PINHOLE 64 48 60 60 32 24")
    return photos(root / "photos"), root / "scene"


def colmap_folder(root: Path) -> tuple[Path, Path]:
    photos(root / "scene/images")
    return colmap_model_alone(root)


def folder_with(name: str) -> Callable[[Path], tuple[Path, Path]]:
    def case(root: Path) -> tuple[Path, Path]:
        (root / "c").mkdir(parents=True)
        (root / "c" / name).write_text("of the user")
        return photos(root / "photos"), root / "c"

    return case


def dangling_link(root: Path) -> tuple[Path, Path]:
    (root / "c").mkdir(parents=True)
    (root / "c/points.ply").symlink_to("/nowhere/points.ply")
    return photos(root / "photos"), root / "c"


def target_that_is_a_file(root: Path) -> tuple[Path, Path]:
    photos(root / "photos")
    return root / "photos", root / "photos/IMG_0.png"


REFUSED: dict[str, tuple[Callable[[Path], tuple[Path, Path]], str]] = {
    "holiday/images -o holiday": (images_of_the_target, "lies where the capture .* would be written"),
    "holiday -o holiday": (folder_of_the_images, "lies where the capture .* would be written"),
    "holiday/images/day1 -o holiday": (folder_in_the_images, "lies where the capture .* would be written"),
    "holiday -o holiday, photographs in it": (the_target_itself, "lies where the capture .* would be written"),
    "holiday/images -o link": (through_a_link, "lies where the capture .* would be written"),
    "photos -o c, c/images is a link to photos": (link_to_the_photographs, "lies where the capture .* would be"),
    "photos -o scene of COLMAP": (colmap_folder, "holds a capture already"),
    "photos -o model of COLMAP without images": (colmap_model_alone, "holds a capture already"),
    "photos -o c with transforms_train.json": (folder_with("transforms_train.json"), "holds a capture already"),
    "photos -o c with transforms_test.json": (folder_with("transforms_test.json"), "holds a capture already"),
    "photos -o c with poses_bounds.npy": (folder_with("poses_bounds.npy"), "holds a capture already"),
    "photos -o c with images": (folder_with("images"), "holds images already"),
    "photos -o c with points.ply": (folder_with("points.ply"), r"holds points\.ply already"),
    "photos -o c with footage.json": (folder_with("footage.json"), r"holds footage\.json already"),
    "photos -o c with transforms.json": (folder_with("transforms.json"), "holds a capture already"),
    "photos -o c with a link to nothing": (dangling_link, r"holds points\.ply already"),
    "photos -o IMG_0.png": (target_that_is_a_file, "is a file, not a folder"),
}


@pytest.mark.parametrize("command", REFUSED)
def test_a_capture_that_would_be_written_over_files_is_refused(tmp_path: Path, command: str) -> None:
    case, problem = REFUSED[command]
    source, target = case(tmp_path)
    before = files(tmp_path)
    with pytest.raises(CaptureError, match=f"{problem}.*[Cc]hoose another folder"):
        make_capture(source, target)
    assert files(tmp_path) == before
    assert not (target / WORKSPACE).exists()


@pytest.mark.parametrize("inner", [".footage/notes.txt", ".footage/frames/a.png"])
def test_a_folder_that_is_called_as_the_workspace_is_not_emptied(tmp_path: Path, inner: str) -> None:
    (tmp_path / "c" / inner).parent.mkdir(parents=True)
    (tmp_path / "c" / inner).write_text("of the user")
    with pytest.raises(CaptureError, match=r"\.footage: is not the workspace of an earlier call"):
        make_capture(photos(tmp_path / "photos"), tmp_path / "c")
    assert (tmp_path / "c" / inner).read_text() == "of the user"


@pytest.mark.parametrize("name", CAPTURE_FILES)
def test_files_that_came_after_an_interrupted_call_are_not_replaced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    source, target = photos(tmp_path / "photos"), tmp_path / "c"
    interrupted_while_placing(source, target, monkeypatch, moved=0)
    (target / name).write_text("of the user")
    before = files(tmp_path)
    with pytest.raises(CaptureError, match=r"holds .* already"):
        make_capture(source, target)
    assert files(tmp_path) == before


def test_files_that_came_while_the_capture_was_made_are_not_replaced(tmp_path: Path) -> None:
    source, target = photos(tmp_path / "photos"), tmp_path / "c"

    def put(phase: str, done: int, total: int) -> None:
        (target / "points.ply").write_text("of the user")

    with pytest.raises(CaptureError, match=r"holds points\.ply already"):
        make_capture(source, target, observe=put)
    assert (target / "points.ply").read_text() == "of the user"
    (target / "points.ply").rename(tmp_path / "points.ply")  # as the remedy says
    make_capture(source, target)
    assert {path.name for path in target.iterdir()} == set(CAPTURE_FILES)


@pytest.mark.parametrize("max_side", [1000, 500])  # of the call that was interrupted, and another one: it begins again
@pytest.mark.parametrize("moved", range(len(CAPTURE_FILES)))
def test_a_call_that_was_interrupted_between_two_files_is_finished(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, moved: int, max_side: int
) -> None:
    source, target = photos(tmp_path / "photos"), tmp_path / "c"
    interrupted_while_placing(source, target, monkeypatch, moved)
    (target / "notes.txt").write_text("of the user")
    report = make_capture(source, target, max_side=max_side)
    assert report.registered == COUNT
    assert {path.name for path in target.iterdir()} == {"notes.txt", *CAPTURE_FILES}
    assert len(list((target / "images").iterdir())) == COUNT


def test_a_capture_that_was_finished_with_times_does_not_become_a_static_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source, target = photos(tmp_path / "photos"), tmp_path / "c"
    interrupted_while_placing(source, target, monkeypatch, moved=0)
    make_capture(source, target, static=True)
    frames = json.loads((target / "transforms.json").read_text())["frames"]
    assert len(frames) == COUNT
    assert not any("time" in frame for frame in frames)


@pytest.mark.parametrize("target", ["photos/out", "c"])
def test_what_else_lies_in_the_folders_stays(tmp_path: Path, target: str) -> None:
    source = photos(tmp_path / "photos")
    (tmp_path / target).mkdir()
    (tmp_path / target / "notes.txt").write_text("of the user")
    before = files(tmp_path)
    make_capture(source, tmp_path / target)
    after = files(tmp_path)
    assert {name: after[name] for name in before} == before
    assert len(after) == len(before) + COUNT + 3


def test_a_folder_below_the_photographs_is_continued_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    photos(tmp_path / "holiday/images")
    interrupted_while_placing(tmp_path / "holiday", tmp_path / "holiday/out", monkeypatch, moved=0)
    assert make_capture(tmp_path / "holiday", tmp_path / "holiday/out").registered == COUNT
