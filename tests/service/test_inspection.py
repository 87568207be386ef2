"""A capture is read beside the service, and what goes wrong there is told."""

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
    """Ends the process that receives it, as a bad image ends a bad reader."""

    def __reduce__(self) -> tuple[Any, ...]:
        return os._exit, (139,)


@pytest.fixture
def config() -> CaptureConfig:
    return make_config("draft", {}).capture


def test_a_crash_of_the_reader_is_a_complaint_about_the_capture(capture: Path, config: CaptureConfig) -> None:
    async def crash_and_go_on() -> None:
        with pytest.raises(CaptureError, match="ended the process") as error:
            await inspect_capture(capture, cast(CaptureConfig, Crash()))
        assert error.value.remedy
        await inspect_capture(capture, config)

    anyio.run(crash_and_go_on)


def test_a_complaint_keeps_its_parts(tmp_path: Path, config: CaptureConfig) -> None:
    (tmp_path / "notes.txt").write_text("nothing to see")
    with pytest.raises(CaptureError) as error:
        anyio.run(partial(inspect_capture, tmp_path, config))
    assert error.value.file == "the archive"
    assert error.value.remedy
    assert str(tmp_path) not in str(error.value)
