"""A capture is read in a separate process, and errors there are reported."""

from __future__ import annotations

import os
from functools import partial
from pathlib import Path
from typing import Any, cast

import anyio
import pytest

from graings.config import CaptureConfig, make_config
from graings.errors import CaptureError
from service.inspection import inspect_capture


class Crash:
    """Ends the process that unpickles it, as a malformed image may crash a decoder."""

    def __reduce__(self) -> tuple[Any, ...]:
        return os._exit, (139,)


@pytest.fixture
def config() -> CaptureConfig:
    return make_config("draft", {}).capture


def test_a_crash_of_the_reader_is_an_error_in_the_capture(capture: Path, config: CaptureConfig) -> None:
    async def crash_and_continue() -> None:
        with pytest.raises(CaptureError, match="ended the reading process") as error:
            await inspect_capture(capture, cast(CaptureConfig, Crash()))
        assert error.value.remedy
        await inspect_capture(capture, config)

    anyio.run(crash_and_continue)


def test_an_error_keeps_its_parts(tmp_path: Path, config: CaptureConfig) -> None:
    (tmp_path / "notes.txt").write_text("no capture")
    with pytest.raises(CaptureError) as error:
        anyio.run(partial(inspect_capture, tmp_path, config))
    assert error.value.file == "the archive"
    assert error.value.remedy
    assert str(tmp_path) not in str(error.value)
