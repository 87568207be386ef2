"""What installations are made of: the image's build context, and packages that some platforms lack."""

from __future__ import annotations

import re
import shlex
import tomllib
from collections.abc import Iterator
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import pytest
from packaging.requirements import Requirement

from graings.colmap import pycolmap_has_a_build, pycolmap_remedy

ROOT = Path(__file__).resolve().parent.parent
PROJECT: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text())
DOCKERFILE = (ROOT / "docker/Dockerfile").read_text().replace("\\\n", " ")

PLATFORMS = {
    "Linux on x86-64": ("linux", "x86_64", True),
    "Linux on ARM": ("linux", "aarch64", False),
    "macOS on ARM": ("darwin", "arm64", True),
}
platforms = pytest.mark.parametrize(("system", "machine", "has_build"), PLATFORMS.values(), ids=PLATFORMS)


def copied() -> list[str]:
    """The sources of the Dockerfile's COPY lines that come from the build context."""
    lines = [line.split()[1:] for line in DOCKERFILE.splitlines() if line.startswith("COPY ")]
    return [source for words in lines if not words[0].startswith("--from") for source in words[:-1]]


def is_sent(name: str) -> bool:
    """Whether .dockerignore lets a file or folder at the root into the build context: the last pattern decides."""
    sent = True
    for pattern in (ROOT / ".dockerignore").read_text().split():
        if fnmatch(name, pattern.removeprefix("!")):
            sent = pattern.startswith("!")
    return sent


@pytest.mark.parametrize("source", copied())
def test_what_the_image_copies_exists_and_is_in_the_build_context(source: str) -> None:
    assert (ROOT / source).exists()
    assert is_sent(source), f"{source} is missing in .dockerignore"


def test_the_image_copies_all_that_the_wheel_is_built_from() -> None:
    project = PROJECT["project"]
    needed = {*PROJECT["tool"]["scikit-build"]["wheel"]["packages"], project["readme"], *project["license-files"]}
    assert needed | {"pyproject.toml", "CMakeLists.txt", "constraints.txt"} <= set(copied())


def test_the_wheel_holds_the_modules_of_all_commands_and_checks() -> None:
    groups = [PROJECT["project"]["scripts"], *PROJECT["project"]["entry-points"].values()]
    modules = {target.partition(":")[0].partition(".")[0] for group in groups for target in group.values()}
    assert modules <= set(PROJECT["tool"]["scikit-build"]["wheel"]["packages"])


def test_the_build_context_holds_nothing_that_is_not_copied() -> None:
    assert {path.name for path in ROOT.iterdir() if is_sent(path.name)} == set(copied())


def image_requirements() -> Iterator[Requirement]:
    """The packages that the Dockerfile names."""
    for command in re.findall(r"pip wheel ([^\n]*)", DOCKERFILE):
        words = iter(shlex.split(command))
        for word in words:
            if word.startswith("--"):
                next(words)
            elif not word.startswith("."):
                yield Requirement(word)


@platforms
def test_pycolmap_is_installed_where_it_has_a_build(system: str, machine: str, has_build: bool) -> None:
    platform = {"sys_platform": system, "platform_machine": machine}
    extra = [Requirement(text) for text in PROJECT["project"]["optional-dependencies"]["colmap"]]
    image = [requirement for requirement in image_requirements() if requirement.name == "pycolmap"]
    assert len(extra) == len(image) == 1
    assert [each.marker is None or each.marker.evaluate(platform) for each in extra] == [has_build]
    if system == "linux":  # an image is always Linux
        assert [each.marker is None or each.marker.evaluate(platform) for each in image] == [has_build]


@platforms
def test_the_remedy_for_a_missing_pycolmap_can_be_followed(
    system: str, machine: str, has_build: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.platform", system)
    monkeypatch.setattr("platform.machine", lambda: machine)
    assert pycolmap_has_a_build() == has_build
    expected = "pip install 'graings[colmap]'" if has_build else f"pycolmap has no build for Linux on {machine}"
    assert pycolmap_remedy() == expected
