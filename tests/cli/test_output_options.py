"""Options of `export` and `video` that cannot be followed: refused by name, before anything is read or made."""

from __future__ import annotations

import errno
import os
import re
from pathlib import Path

import pytest
from typer.testing import CliRunner

from graings.cli.main import app, main
from graings.export.export import FORMATS, SEVERAL, WHOLE
from graings.export.shown import open_shown
from graings.storage.compact import write_compact
from tests.export.models import tiny_model

SINGLE = [format for format in FORMATS if format not in SEVERAL]


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("model") / "tiny.graings"
    write_compact(tiny_model(), file)
    return file


def answer(*arguments: object) -> tuple[int, str]:
    """Exit code and text of a command, whose lines and frames are joined."""
    found = CliRunner().invoke(app, [str(argument) for argument in arguments])
    return found.exit_code, " ".join(found.output.replace("│", " ").split())


@pytest.mark.parametrize(
    ("format", "name", "value"),
    [
        *((format, "time", "0.5") for format in (*WHOLE, *SEVERAL)),
        *((format, "frames", "7") for format in (*WHOLE, *SINGLE)),
        *((format, "degree", "1") for format in (*WHOLE, "splat")),
    ],
)
def test_an_option_that_a_format_does_not_use_is_refused(format: str, name: str, value: str, tmp_path: Path) -> None:
    code, text = answer("export", tmp_path / "absent", "-o", tmp_path / f"a.{format}", f"--{name}", value)
    assert code == 2
    assert re.search(rf"{name} .*\.{re.escape(format)} file", text)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("command", "format"),
    [
        *(("export", format) for format in (*FORMATS, *WHOLE)),
        *(("render", "png"), ("render", "exr"), ("inspect", "png")),
    ],
)
@pytest.mark.parametrize("place", ["missing", "a file", "a folder"])
def test_a_place_where_no_file_can_be_is_refused_before_the_model_is_read(
    command: str, format: str, place: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output = tmp_path / "there" / f"a.{format}"
    if place == "a file":
        (tmp_path / "there").write_text("mine")
    elif place == "a folder":
        output.mkdir(parents=True)
    with pytest.raises(SystemExit) as ended:
        main([command, str(tmp_path / "absent"), "-o", str(output)])
    assert ended.value.code == 74
    message = capsys.readouterr().err
    assert message.startswith(f"{output}: ")
    assert ("is a folder" if place == "a folder" else f"there is no folder {output.parent}") in message
    assert "absent" not in message


@pytest.mark.skipif(not Path("/sys").is_dir(), reason="no read-only folder")
def test_a_read_only_folder_is_refused_before_the_model_is_read(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["export", "absent", "-o", "/sys/a.ply"])
    assert ended.value.code == 74
    assert "/sys/a.ply: cannot be written (" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["look.jpg", "look.pdf", "look"])
def test_a_picture_of_a_capture_under_the_name_of_another_format_is_refused(name: str, tmp_path: Path) -> None:
    code, text = answer("inspect", tmp_path / "absent", "-o", tmp_path / name)
    assert code == 2
    assert f"{name}mustendin.png" in text.replace(" ", "")  # lines break anywhere in a long path
    assert "absent" not in text


@pytest.mark.parametrize(("command", "name"), [("render", "a.png"), ("export", "a.ply"), ("export", "a.graings")])
def test_a_full_disk_is_said_with_the_file_and_without_a_training(
    model: Path,
    command: str,
    name: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(SystemExit) as ended:
        main([command, str(model), "-o", str(tmp_path / name)])
    assert ended.value.code == 74
    message = " ".join(capsys.readouterr().err.split())
    assert message.startswith(f"{tmp_path / name}: ")
    assert "No space left on device" in message
    assert "resume" not in message
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--moves", "time", "--path", "views"], "path is for a camera that moves"),
        (["--moves", "time", "--path", "keys.json"], "path is for a camera that moves"),
        (["--path", "views", "--camera", "train:0"], "so camera would have no effect"),
        (["--path", "keys.json", "--azimuth", "3", "--radius", "2"], "so azimuth, radius would have no effect"),
        (["--t", "0.5"], "t is the time while only the camera moves"),
    ],
)
def test_an_option_that_a_path_does_not_use_is_refused(
    model: Path, tmp_path: Path, options: list[str], message: str
) -> None:
    code, text = answer("video", model, "-o", tmp_path / "a.gif", *options)
    assert code == 2
    assert message in text
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("command", ["render", "video"])
def test_a_vertical_axis_is_refused_for_a_model_which_has_its_own(model: Path, command: str, tmp_path: Path) -> None:
    output = tmp_path / ("a.png" if command == "render" else "a.gif")
    code, text = answer(command, model, "-o", output, "--up", 0, 0, 1)
    assert code == 2
    assert "up is for files of splats" in text
    assert list(tmp_path.iterdir()) == []


def test_a_rate_that_gif_does_not_have_is_refused_before_the_model_is_read(tmp_path: Path) -> None:
    code, text = answer("video", tmp_path / "absent", "-o", tmp_path / "a.gif", "--fps", 120)
    assert code == 2
    assert "fps must lie in [0.1, 100] for a .gif file" in text


@pytest.mark.parametrize(("suffix", "size"), [(".mp4", "32 x 20"), (".gif", "33 x 21")])
def test_the_size_that_is_printed_is_that_of_the_file(model: Path, suffix: str, size: str, tmp_path: Path) -> None:
    av = pytest.importorskip("av")
    output = tmp_path / f"a{suffix}"
    options = ("--moves", "time", "--seconds", 0.1, "--width", 33, "--height", 21)
    code, text = answer("video", model, "-o", output, *options)
    assert code == 0, text
    assert f"frames, {size}, " in text
    with av.open(str(output)) as container:
        video = container.streams.video[0]
        assert f"{video.width} x {video.height}" == size


def test_what_is_left_out_has_the_default_of_its_format(model: Path, tmp_path: Path) -> None:
    code, text = answer("export", model, "-o", tmp_path / "a.ply")
    assert code == 0, text
    assert "splats at t = 0, " in text
    assert open_shown(tmp_path / "a.ply").units.scale > 0
    code, text = answer("export", model, "-o", tmp_path / "a.splat")
    assert code == 0, text
    assert "harmonics of degree 0" in text
    code, text = answer("export", model, "-o", tmp_path / "a.zip", "--degree", 0)
    assert code == 0, text
    assert "at 30 times" in text
