"""WorkingCopy: a copy of the package that may be changed, built with other options and tested."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

COPIED = ("graings", "tests", "CMakeLists.txt", "pyproject.toml")

# An editable installation adds an import finder that would take precedence over the copy; it is removed.
RUN_PYTEST = """
import sys
sys.meta_path = [finder for finder in sys.meta_path if "ScikitBuild" not in type(finder).__name__]
sys.path.insert(0, sys.argv[1])
import graings
assert graings.__file__.startswith(sys.argv[1]), graings.__file__
import pytest
sys.exit(pytest.main(sys.argv[2:]))
"""


class WorkingCopy:
    """A copy of `root` in `folder`, configured with CMake's `options` and built by `build` with `jobs` compilers."""

    def __init__(self, root: Path, folder: Path, jobs: int, *options: str) -> None:
        if shutil.which("cmake") is None:
            raise SystemExit("CMake is not installed, which builds the kernel here: pip install cmake")
        self.folder, self.jobs = folder, jobs
        for name in COPIED:
            source, target = root / name, folder / name
            if source.is_dir():
                shutil.copytree(source, target, ignore=shutil.ignore_patterns("__pycache__", "_kernel*"))
            else:
                shutil.copy2(source, target)
        python = f"-DPython_EXECUTABLE={sys.executable}"
        self._run("cmake", "-S", ".", "-B", "build", "-DCMAKE_BUILD_TYPE=Release", python, *options)

    def build(self) -> None:
        """Build the kernel. Raises `SystemExit` if that fails."""
        self._run("cmake", "--build", "build", "--target", "_kernel", "--parallel", str(self.jobs))
        for module in (self.folder / "build").glob("_kernel*.so"):
            shutil.copy2(module, self.folder / "graings/kernel")

    def pytest(self, *arguments: str, environment: Mapping[str, str] | None = None) -> subprocess.CompletedProcess[str]:
        """Run tests of the copy with additional environment variables; returns the finished process."""
        return subprocess.run(
            [sys.executable, "-c", RUN_PYTEST, str(self.folder), "-p", "no:cacheprovider", *arguments],
            cwd=self.folder,
            env=os.environ | dict(environment or {}),
            capture_output=True,
            text=True,
            check=False,
        )

    def _run(self, *command: str) -> None:
        ran = subprocess.run(command, cwd=self.folder, capture_output=True, text=True, check=False)
        if ran.returncode != 0:
            raise SystemExit(f"{' '.join(command)} failed:\n{ran.stdout[-4000:]}\n{ran.stderr[-4000:]}")
