"""jobs and service name the reason where they cannot run."""

from __future__ import annotations

import subprocess
import sys

import pytest


@pytest.mark.parametrize("module", ["jobs", "jobs.commands", "service.commands"])
def test_without_fcntl_the_import_fails_with_the_reason_and_a_remedy(module: str) -> None:
    program = f"import sys; sys.modules['fcntl'] = None; import {module}"
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert ended.returncode == 1
    last = ended.stderr.splitlines()[-1]
    assert "fcntl" in last
    assert "Windows" in last
    assert "WSL" in last
