"""Signals during a print or without a reader of the output."""

from __future__ import annotations

import io
import os
import signal

import pytest
from rich.console import Console

from graings.cli.interrupt import Interrupt


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
