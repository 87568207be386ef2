from __future__ import annotations

import errno
import json
import re
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import pytest
import typer

from graings.capture.synthetic import write_synthetic
from graings.cli.main import Commands, app, main
from graings.config import TrainConfig, make_config
from graings.evaluation.metrics import psnr
from graings.storage.checkpoint import load_model, newest_checkpoint
from graings.training.run import TrainingRun

ROOT = Path(__file__).resolve().parents[2]

TINY = (
    *("--preset", "draft", "--threads", "1"),
    *("--set", "init.points=800", "--set", "scene.children=4", "--set", "evaluation.first=5"),
)


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_synthetic(tmp_path_factory.mktemp("capture") / "tiny", seed=1, frames=12, size=32, bodies=2)


@pytest.fixture(scope="module")
def run(capture: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("runs") / "tiny"
    assert graings("train", capture, "-o", folder, *TINY, "--set", "iterations=20") == 0
    return folder


def graings(*arguments: object) -> int:
    """The exit code of a command line."""
    with pytest.raises(SystemExit) as exit_:
        main([str(argument) for argument in arguments])
    code = exit_.value.code
    assert isinstance(code, int)
    return code


def pixels(file: Path) -> np.ndarray:
    image = oiio.ImageBuf(str(file)).get_pixels(oiio.FLOAT)
    assert isinstance(image, np.ndarray)
    return image


def test_training_writes_a_finished_model_and_its_metrics(run: Path) -> None:
    model = load_model(run)
    assert (model.iteration, model.finished, model.config.preset) == (20, True, "draft")
    assert model.config.init.points == 800
    document = json.loads((run / "metrics.json").read_text())
    assert list(document["splits"]) == ["val"]


def test_a_second_run_does_not_overwrite_the_first(
    capture: Path, run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert graings("train", capture, "-o", run, *TINY) == 65
    assert "--resume" in capsys.readouterr().err


def test_resuming_a_finished_run_changes_nothing(run: Path) -> None:
    before = newest_checkpoint(run)
    assert graings("train", "--resume", "-o", run) == 0
    assert newest_checkpoint(run) == before


@pytest.mark.parametrize(
    "number",
    [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.slow(reason="a second process for the same path"))],
)
def test_an_interrupted_training_keeps_a_checkpoint_and_prints_how_to_continue(
    capture: Path, tmp_path: Path, number: signal.Signals
) -> None:
    folder = tmp_path / "run"
    command = [sys.executable, "-m", "graings", "train", str(capture), "-o", str(folder), *TINY]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        for line in process.stdout:
            if "held out" in line:
                break
        process.send_signal(number)
        rest = process.stdout.read()
    assert process.returncode == 128 + number
    assert f"graings train --resume -o {folder}" in rest
    assert 0 < load_model(folder).iteration < make_config("draft").iterations


def test_evaluating_test_views_adds_them_to_metrics_json(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert graings("evaluate", run, "--split", "test") == 0
    document = json.loads((run / "metrics.json").read_text())
    assert sorted(document["splits"]) == ["test", "val"]
    assert f"PSNR {document['splits']['test']['psnr']:.2f} dB" in capsys.readouterr().out


def test_evaluating_on_another_background_does_not_change_metrics_json(
    run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = (run / "metrics.json").read_bytes()
    outputs = []
    for background in ("white", "black"):
        assert graings("evaluate", run, "--background", background) == 0
        outputs.append(capsys.readouterr().out)
        assert f"On {background};" in outputs[-1]
    assert (run / "metrics.json").read_bytes() == before
    assert f"PSNR {json.loads(before)['splits']['val']['psnr']:.2f} dB" in outputs[0]
    assert "PSNR" in outputs[1]
    assert outputs[1] != outputs[0]


def test_a_fast_view_differs_by_what_is_printed(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    view = ("--camera", "test:1", "--t", 0.3)
    assert graings("render", run, *view, "-o", tmp_path / "exact.png") == 0
    assert "Fast" not in capsys.readouterr().out
    assert graings("render", run, *view, "--fast", "-o", tmp_path / "fast.png") == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "px for 99 %" in printed
    found = psnr(pixels(tmp_path / "fast.png"), pixels(tmp_path / "exact.png"))
    said = re.search(r"PSNR of ([0-9.]+) dB", printed)
    assert said is not None
    assert float(said.group(1)) == pytest.approx(found, abs=0.051)  # printed with one decimal, of 8-bit pixels
    assert found > 35


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".webp", ".exr"])
def test_the_file_name_chooses_the_format(run: Path, tmp_path: Path, suffix: str) -> None:
    file = tmp_path / f"view{suffix}"
    assert graings("render", run, "--camera", "test:1", "-o", file) == 0
    assert pixels(file).shape == (32, 32, 3)


def test_a_view_by_name_and_the_same_view_by_pose_are_the_same_image(run: Path, tmp_path: Path) -> None:
    model = load_model(run)
    camera = model.views["test"][1].camera
    pose = {
        "world_to_camera": model.units.camera_back(camera).tolist(),
        **{key: getattr(camera, key) for key in ("fx", "fy", "cx", "cy", "width", "height")},
    }
    (tmp_path / "pose.json").write_text(json.dumps(pose))
    assert graings("render", run, "--t", 0.25, "--camera", "test:1", "-o", tmp_path / "a.exr") == 0
    assert graings("render", run, "--t", 0.25, "--pose", tmp_path / "pose.json", "-o", tmp_path / "b.exr") == 0
    a, b = pixels(tmp_path / "a.exr"), pixels(tmp_path / "b.exr")
    assert a.std() > 0.01  # the image is not empty
    # Going to capture units and back moves a camera by rounding only; half floats are 2^-11 apart.
    assert np.abs(a - b).max() <= 2.0**-11


def test_an_orbit_takes_size_and_background(run: Path, tmp_path: Path) -> None:
    file = tmp_path / "view.png"
    far = ("--azimuth", 40, "--elevation", 10, "--radius", 1000, "--fov", 30)
    assert graings("render", run, *far, "--width", 48, "--height", 20, "--background", "#ff0000", "-o", file) == 0
    image = pixels(file)
    assert image.shape == (20, 48, 3)
    np.testing.assert_array_equal(image[0, 0], (1.0, 0.0, 0.0))


def test_a_time_outside_the_capture_is_clamped_with_a_message(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert graings("render", run, "--t", 1.5, "--camera", "test:0", "-o", tmp_path / "late.png") == 0
    assert "1.5 is outside" in capsys.readouterr().out
    assert graings("render", run, "--t", 1.0, "--camera", "test:0", "-o", tmp_path / "end.png") == 0
    np.testing.assert_array_equal(pixels(tmp_path / "late.png"), pixels(tmp_path / "end.png"))


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (["--camera", "test:99"], "test:0 to test:"),
        (["--camera", "test:0", "--azimuth", "3"], "choose one viewpoint"),
        (["--elevation", "91"], "elevation"),
        (["--t", "nan"], "t must be"),
        (["--background", "pink"], "background"),
        (["--width", "0"], "width"),
        (["--camera", "test:0", "-o", "view.gif"], "gif"),
    ],
)
def test_an_impossible_view_is_a_usage_error(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], word: str
) -> None:
    assert graings("render", run, "-o", tmp_path / "view.png", *arguments) == 2
    assert word in " ".join(capsys.readouterr().err.split())
    assert list(tmp_path.iterdir()) == []


def test_a_pose_file_without_a_key_is_refused_by_its_name(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pose = tmp_path / "pose.json"
    pose.write_text(json.dumps({"world_to_camera": np.eye(4).tolist(), "fx": 50.0}))
    assert graings("render", run, "--pose", pose, "-o", tmp_path / "view.png") == 2
    assert "width, height missing" in " ".join(capsys.readouterr().err.replace("│", " ").split())


@pytest.mark.parametrize(("content", "word"), [("[" * 100_000, "not JSON"), ("[1]", "must be a JSON object")])
def test_a_malformed_pose_file_is_refused(
    run: Path, tmp_path: Path, content: str, word: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "pose.json").write_text(content)
    assert graings("render", run, "--pose", tmp_path / "pose.json", "-o", tmp_path / "view.png") == 2
    assert word in " ".join(capsys.readouterr().err.replace("│", " ").split())


def test_a_missing_pose_file_is_an_input_error(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert graings("render", run, "--pose", tmp_path / "none.json", "-o", tmp_path / "view.png") == 74
    assert "none.json: No such file or directory. Check the path." in " ".join(capsys.readouterr().err.split())


@pytest.mark.skipif(not Path("/sys").is_dir(), reason="no read-only folder")
def test_a_read_only_path_is_named_with_a_remedy(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert graings("render", run, "-o", "/sys/view.png") == 74
    message = " ".join(capsys.readouterr().err.split())
    assert "/sys/view.png: cannot be written" in message
    assert "Name another place" in message


@pytest.mark.parametrize("file", [None, "FILE"])
def test_a_full_disk_during_training_is_said_with_how_to_go_on(
    capture: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    file: str | None,
) -> None:
    def steps(_: TrainingRun) -> Iterator[None]:
        yield from ()
        raise OSError(errno.ENOSPC, "No space left on device", file)

    monkeypatch.setattr(TrainingRun, "__iter__", steps)
    assert graings("train", capture, "-o", tmp_path / "run", *TINY) == 74
    message = " ".join(capsys.readouterr().err.split())
    there = "FILE: No space left on device. Free some space there. "
    anywhere = f"No space left on device. Free some space where the files go, or in {tempfile.gettempdir()}. "
    expected = f"{anywhere if file is None else there}Then continue with: graings train --resume -o {tmp_path / 'run'}"
    assert message.endswith(expected)


@pytest.mark.parametrize(
    ("arguments", "code", "word"),
    [
        (["train", "CAPTURE", "-o", "RUN", "--set", "iterations=0"], 2, "iterations"),
        (["train", "CAPTURE", "-o", "RUN", "--set", "no.such=1"], 2, "no"),
        (["train", "CAPTURE", "-o", "RUN", "--set", "iterations"], 2, "key=value"),
        (["train", "CAPTURE", "-o", "RUN", "--preset", "best"], 2, "draft, standard, fine, long, paper"),
        (["train", "CAPTURE", "-o", "RUN", "--resume", "--set", "seed=1"], 2, "keeps its options"),
        (["train", "-o", "RUN"], 2, "capture"),
        (["train", "ABSENT", "-o", "RUN"], 65, "absent"),
        (["train", "--resume", "-o", "RUN"], 65, "no run to resume"),
        (["render", "RUN", "-o", "view.png"], 65, "no checkpoint"),
        (["evaluate", "RUN"], 65, "no checkpoint"),
        (["evaluate", "RUN", "--split", "train"], 2, "split"),
        (["evaluate", "RUN", "--background", "pink"], 2, "background"),
        (["juggle"], 2, "juggle"),
    ],
)
def test_a_mistake_is_one_clear_message_with_its_exit_code(
    capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], code: int, word: str
) -> None:
    places = {"CAPTURE": capture, "RUN": tmp_path / "run", "ABSENT": tmp_path / "absent"}
    assert graings(*(places.get(argument, argument) for argument in arguments)) == code
    message = capsys.readouterr().err
    assert word in message
    assert "Traceback" not in message
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("command", [["train", "CAPTURE"], ["ablate", "CAPTURE"], ["report", "RUN"]])
@pytest.mark.parametrize("below", ["", "below"])
def test_a_file_where_a_folder_is_needed_is_named_and_not_changed(
    capture: Path, run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], command: list[str], below: str
) -> None:
    taken = tmp_path / "taken"
    taken.write_text("content")
    places = {"CAPTURE": capture, "RUN": run}
    assert graings(*(places.get(word, word) for word in command), "-o", taken / below) != 0
    message = capsys.readouterr().err
    assert f"{taken}: " in message
    assert "Errno" not in message
    assert taken.read_text() == "content"


def test_help_documents_the_exit_codes(capsys: pytest.CaptureFixture[str]) -> None:
    assert graings("--help") == 0
    page = " ".join(capsys.readouterr().out.split())
    assert "65 the capture or checkpoint cannot be used" in page
    for command in ("train", "render", "evaluate", "report", "options"):
        assert command in page


def test_options_are_listed_with_value_bounds_and_help(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    assert graings("options", "--preset", "draft") == 0
    lines = {line.split()[0]: line for line in capsys.readouterr().out.splitlines() if line.strip()}
    assert lines["density.max_anchors"].split()[:5] == ["density.max_anchors", "1600", "*", "≥", "16"]
    assert lines["density.levels"].split()[:4] == ["density.levels", "3", "≥", "1,"]
    assert "Maximum number of anchors after growth" in lines["density.max_anchors"]
    assert lines["rates.deformation"].split() == ["rates.deformation", "[0.002,", "5e-05]", "≥", "0", "DeformNet."]


def test_every_option_has_a_description() -> None:
    def without_description(schema: dict[str, Any]) -> list[str]:
        parts = {"TrainConfig": schema, **schema["$defs"]}
        fields = [
            (f"{part}.{name}", option) for part, facts in parts.items() for name, option in facts["properties"].items()
        ]
        return [name for name, option in fields if "description" not in option and "$ref" not in option]

    assert without_description(TrainConfig.model_json_schema()) == []


def test_options_as_json_are_the_schema(capsys: pytest.CaptureFixture[str]) -> None:
    assert graings("options", "--json") == 0
    document = json.loads(capsys.readouterr().out)
    schedules = {name: (preset["iterations"], preset["batch"]) for name, preset in document["presets"].items()}
    assert schedules == {
        "draft": (1_100, 4),
        "standard": (5_000, 4),
        "fine": (15_000, 4),
        "long": (30_000, 1),
        "paper": (30_000, 1),
    }
    assert "iterations" in document["schema"]["properties"]


@pytest.fixture
def plugins(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An installed package with a command that works and one that needs a missing package."""
    info = tmp_path / "juggling-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: juggling\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(
        "[graings.commands]\njuggle = juggling_commands:juggle\nfloat = juggling_balloons:float\n"
    )
    (tmp_path / "juggling_commands.py").write_text(
        "def juggle(balls: int = 3) -> None:\n    '''Keep balls in the air.'''\n    print(f'{balls} balls')\n"
    )
    (tmp_path / "juggling_balloons.py").write_text("import package_that_is_not_there\n")
    monkeypatch.syspath_prepend(tmp_path)


def test_help_names_every_command(capsys: pytest.CaptureFixture[str]) -> None:
    assert graings("--help") == 0
    text = capsys.readouterr().out
    rows = re.findall(r"│ ([a-z]+)  +\S", text)
    command = typer.main.get_command(app)
    assert isinstance(command, Commands)
    assert rows == command.list_commands(typer.Context(command))
    assert {"train", "demo", "keys", "serve", "worker"} <= set(rows)


@pytest.mark.usefixtures("plugins")
def test_an_installed_package_can_add_a_command(capsys: pytest.CaptureFixture[str]) -> None:
    assert graings("juggle", "--balls", 5) == 0
    assert capsys.readouterr().out == "5 balls\n"
    assert graings("--help") == 0
    assert "Keep balls in the air." in capsys.readouterr().out


@pytest.mark.usefixtures("plugins")
def test_a_command_that_cannot_be_imported_fails_with_the_reason_only_when_it_is_used(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert graings("options", "--json") == 0
    capsys.readouterr()
    assert graings("float", "--high", "up") == 69
    assert "package_that_is_not_there" in capsys.readouterr().err


def test_an_exported_model_renders_like_its_run(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "scene.graings"
    assert graings("export", run, "-o", file) == 0
    assert f"{file.stat().st_size / 1e6:.2f} MB" in capsys.readouterr().out
    for model, name in ((run, "run.png"), (file, "file.png")):
        assert graings("render", model, "--camera", "val:1", "-o", tmp_path / name) == 0
    assert np.abs(pixels(tmp_path / "run.png") - pixels(tmp_path / "file.png")).max() < 0.02
    file.write_bytes(b"no model")
    assert graings("render", file, "-o", tmp_path / "view.png") == 65
    assert "Export it again" in capsys.readouterr().err
