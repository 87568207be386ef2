"""Signals during a print or without a reader of the output."""

from __future__ import annotations

import io
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from rich.console import Console

from graings.cli.interrupt import Interrupt
from graings.storage.run_folder import RECORD_FILE, checkpoints
from graings.training.run import TrainingRun
from tests.training.video import write_video


class _Interrupted(io.RawIOBase):
    """A file during whose first write the user presses Ctrl-C."""

    def __init__(self, number: signal.Signals) -> None:
        self.number: signal.Signals | None = number
        self.written = b""

    def writable(self) -> bool:
        return True

    def write(self, data: object) -> int:
        number, self.number = self.number, None
        if number is not None:
            os.kill(os.getpid(), number)
        self.written += bytes(data)  # type: ignore[call-overload]
        return len(data)  # type: ignore[arg-type]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_during_a_print_is_confirmed_and_breaks_nothing(
    number: signal.Signals, capfd: pytest.CaptureFixture[str]
) -> None:
    raw = _Interrupted(number)
    console = Console(file=io.TextIOWrapper(io.BufferedWriter(raw), encoding="utf-8"))
    before = signal.getsignal(number)
    with Interrupt("stopping soon") as interrupt:
        assert interrupt.received is None
        console.print("a line")
        assert interrupt.received == number
        assert signal.getsignal(number) == before  # a second one ends the process
        console.print("another")
    assert raw.written.split(b"\n")[:2] == [b"a line", b"another"]
    assert "stopping soon" in capfd.readouterr().err
    assert interrupt.exit_code == 128 + number


def test_a_signal_is_recorded_also_if_the_reader_of_the_output_has_ended() -> None:
    """Ctrl-C goes to the whole pipe: with `2>&1 | tee log` the reader has ended when the message is written."""
    reading, writing = os.pipe()
    os.close(reading)
    kept = os.dup(2)
    os.dup2(writing, 2)
    try:
        with Interrupt("stopping soon") as interrupt:
            os.kill(os.getpid(), signal.SIGINT)
            assert interrupt.received == signal.SIGINT
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(writing)


@pytest.mark.parametrize(
    "number",
    [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.slow(reason="a second process for the same path"))],
)
def test_a_training_stopped_while_it_looks_for_what_moves_can_be_resumed(
    number: signal.Signals, tmp_path: Path
) -> None:
    capture, folder = write_video(tmp_path / "capture", 1.2), tmp_path / "run"
    command = [sys.executable, "-m", "graings", "train", str(capture), "-o", str(folder), "--set", "iterations=1000"]
    command += ["--preset", "draft", "--threads", "1"]

    def heed() -> None:
        """A shell without job control starts what runs in the background, and its children, with SIGINT ignored."""
        signal.signal(number, signal.SIG_DFL)

    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, preexec_fn=heed) as process:
        while not (folder / RECORD_FILE).exists():
            assert process.poll() is None
            time.sleep(0.01)
        process.send_signal(number)
        printed, _ = process.communicate()
    assert process.returncode in (128 + number, -number)
    assert not checkpoints(folder)
    if number == signal.SIGINT:
        assert f"graings train --resume -o {folder}" in printed
    first = next(iter(TrainingRun.resume(folder)))
    assert first.iteration == 1
    assert "motion" in {event.kind for event in first.events}
