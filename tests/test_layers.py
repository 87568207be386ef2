"""Who may know whom: docs/architecture.md as a table, checked on the syntax tree of every module."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("graings", "jobs", "service")

# A module or package, and what of our own it may import. The longest matching name decides; every module of
# `graings` that lies in no package has its own line.
LAYERS: dict[str, tuple[str, ...]] = {
    "graings": (),
    # The ground: words that everyone shares.
    "graings.constants": (),
    "graings.kernel": ("graings.errors",),
    "graings.threads": ("graings.kernel",),
    "graings.errors": (),
    "graings.camera": (),
    "graings.gaussians": (),
    "graings.units": ("graings.camera",),
    "graings.config": ("graings.errors",),
    "graings.resolution": ("graings.camera", "graings.config"),
    "graings.seeds": (),
    # Three siblings, strangers to each other.
    "graings.capture": ("graings.capture", "graings.camera", "graings.units", "graings.config", "graings.errors"),
    "graings.scene": (
        *("graings.scene", "graings.camera", "graings.gaussians", "graings.config", "graings.constants"),
        *("graings.kernel", "graings.seeds"),
    ),
    "graings.raster": (
        *("graings.raster", "graings.camera", "graings.gaussians", "graings.constants", "graings.errors"),
        "graings.kernel",
    ),
    # Scene and rasterizer meet here and nowhere else.
    "graings.render": ("graings.camera", "graings.raster", "graings.scene"),
    # What is done with a scene.
    "graings.viewpoint": ("graings.camera", "graings.units"),
    "graings.encode": (),
    "graings.machine": ("graings", "graings.errors", "graings.kernel"),
    "graings.metrics": (),
    "graings.drawing": (),
    "graings.report": ("graings.drawing", "graings.errors"),
    "graings.work_precision": ("graings.drawing", "graings.errors", "graings.report"),
    "graings.tables": ("graings.work_precision",),
    "graings.plots": ("graings.drawing", "graings.report"),
    "graings.render_plot": ("graings.drawing", "graings.plots"),
    "graings.picture": (),
    "graings.render_precision": (
        *("graings.camera", "graings.kernel", "graings.machine", "graings.model", "graings.raster.result"),
        *("graings.render", "graings.scene", "graings.work_precision"),
    ),
    "graings.report_folder": (
        *("graings.compact", "graings.errors", "graings.picture", "graings.plots", "graings.render_plot"),
        *("graings.render_precision", "graings.report", "graings.tables", "graings.work_precision"),
    ),
    "graings.plan": ("graings.capture.capture", "graings.config"),
    "graings.run_folder": ("graings.errors",),
    "graings.model": (*("graings.camera", "graings.config", "graings.resolution", "graings.scene", "graings.units"),),
    "graings.checkpoint": (
        *("graings.camera", "graings.config", "graings.errors", "graings.model", "graings.run_folder"),
        *("graings.scene", "graings.units"),
    ),
    "graings.compact": (
        *("graings.checkpoint", "graings.constants", "graings.errors", "graings.model", "graings.run_folder"),
        "graings.scene",
    ),
    "graings.evaluation": (
        *("graings.capture", "graings.compact", "graings.errors", "graings.metrics", "graings.render"),
        *("graings.report", "graings.run_folder", "graings.scene"),
    ),
    "graings.training": (
        *("graings.training", "graings.capture", "graings.scene", "graings.raster", "graings.render"),
        *("graings.camera", "graings.checkpoint", "graings.config", "graings.constants", "graings.errors"),
        *("graings.evaluation", "graings.machine", "graings.metrics", "graings.plan", "graings.report"),
        *("graings.gaussians", "graings.resolution", "graings.run_folder", "graings.units", "graings.threads"),
        *("graings.compact", "graings.model", "graings.report_folder", "graings.seeds", "graings.work_precision"),
    ),
    # Many runs. The table and its drawing know numbers, not runs.
    "graings.ablation": (),
    "graings.ablation.rows": ("graings.config", "graings.errors"),
    "graings.ablation.table": ("graings.ablation.rows",),
    "graings.ablation.plot": ("graings.ablation.rows", "graings.ablation.table", "graings.drawing"),
    "graings.ablation.experiment": (
        *("graings.ablation", "graings.capture", "graings.config", "graings.errors", "graings.picture"),
        *("graings.report", "graings.training.run"),
    ),
    # The terminal.
    "graings.progress": ("graings.training.journal", "graings.training.run"),
    "graings.interrupt": (),
    "graings.terminal": (),
    "graings.cli_training": (
        *("graings.ablation", "graings.config", "graings.interrupt", "graings.progress", "graings.report"),
        *("graings.terminal", "graings.training.run"),
    ),
    "graings.cli": (
        *("graings.camera", "graings.cli_training", "graings.compact", "graings.config", "graings.encode"),
        *(
            "graings.errors",
            "graings.evaluation",
            "graings.model",
            "graings.render",
            "graings.report_folder",
            "graings.terminal",
        ),
        *("graings.threads", "graings.viewpoint", "graings.work_precision"),
    ),
    "graings.__main__": ("graings.cli",),
    # Durable work knows the method by its options and its files; one child process knows how to train.
    "jobs": ("jobs", "graings.config", "graings.errors", "graings.run_folder"),
    "jobs.trainer_process": (
        *("jobs", "graings.errors", "graings.config", "graings.report_folder", "graings.training.run"),
    ),
    # HTTP never trains.
    "service": (
        *("service", "jobs", "graings", "graings.camera", "graings.capture.load", "graings.compact"),
        *("graings.config", "graings.encode", "graings.errors", "graings.model", "graings.render"),
        *("graings.run_folder", "graings.threads", "graings.units", "graings.viewpoint"),
    ),
    "service.demo": ("service", "jobs", "graings.capture.synthetic", "graings.errors"),
}

# Libraries with one home. The longest name decides here too.
HOMES: dict[str, tuple[str, ...]] = {
    "dbos": ("jobs.engine",),
    "fastapi": ("service",),
    "starlette": ("service",),
    "uvicorn": ("service",),
    "typer": ("graings.cli", "graings.cli_training", "jobs.commands", "service.commands", "service.demo"),
    "rich": (
        *("graings.cli", "graings.cli_training", "graings.progress", "graings.terminal", "jobs.commands"),
        *("service.commands", "service.demo"),
    ),
    "OpenImageIO": ("graings.capture", "graings.encode"),
    "pycolmap": ("graings.capture",),
    "lpips": ("graings.metrics",),
    "matplotlib": ("graings.picture",),
    "safetensors": ("graings.checkpoint", "graings.compact"),
}

# Optional extras: heavy, or absent from most machines.
MAY_BE_IMPORTED_LATE = {"pycolmap", "lpips", "matplotlib"}

FORBIDDEN_NAMES = {"util", "utils", "helper", "helpers", "manager", "misc", "common", "tools"}

MODULES = {
    ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path
    for package in PACKAGES
    for path in sorted((ROOT / package).rglob("*.py"))
}


def imports(tree: ast.AST) -> Iterator[tuple[str, int]]:
    """Module names that a tree imports, as far as they can be read from it, with their lines."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((alias.name, node.lineno) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = "." * node.level + (node.module or "")
            # `from graings.training import losses` names the module graings.training.losses.
            yield from (
                (f"{base}.{alias.name}" if f"{base}.{alias.name}" in MODULES else base, node.lineno)
                for alias in node.names
            )


def within(name: str, place: str) -> bool:
    return name == place or name.startswith(f"{place}.")


def layer(name: str) -> str | None:
    """The line of the table for a module; `graings` itself speaks only for its `__init__`."""
    fitting = [key for key in LAYERS if within(name, key) and (key != "graings" or name == "graings")]
    return max(fitting, key=len, default=None)


def allowed(name: str, target: str) -> bool:
    key = layer(name)
    # `graings` alone is the version number, not everything below.
    return key is not None and any(
        target == place if place == "graings" else within(target, place) for place in LAYERS[key]
    )


def parsed(name: str) -> ast.Module:
    return ast.parse(MODULES[name].read_text(encoding="utf-8"))


@pytest.mark.parametrize("name", MODULES)
def test_a_module_imports_only_from_layers_below(name: str) -> None:
    assert layer(name) is not None, f"{name} has no line in the table"
    wrong = [
        f"{target} (line {line})"
        for target, line in imports(parsed(name))
        if target.split(".")[0] in PACKAGES and not allowed(name, target)
    ]
    assert wrong == []


@pytest.mark.parametrize("name", MODULES)
def test_a_library_with_one_home_is_imported_only_there(name: str) -> None:
    wrong = [
        f"{target} (line {line})"
        for target, line in imports(parsed(name))
        if (library := target.split(".")[0]) in HOMES and not any(within(name, home) for home in HOMES[library])
    ]
    assert wrong == []


@pytest.mark.parametrize("name", MODULES)
def test_imports_are_absolute_named_and_at_the_top(name: str) -> None:
    tree = parsed(name)
    relative = [node.lineno for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) and node.level]
    stars = [
        node.lineno
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and any(alias.name == "*" for alias in node.names)
    ]
    late = [
        f"{target} (line {line})"
        for function in ast.walk(tree)
        if isinstance(function, ast.FunctionDef | ast.AsyncFunctionDef)
        for target, line in imports(function)
        if target.split(".")[0] not in MAY_BE_IMPORTED_LATE
    ]
    assert (relative, stars, late) == ([], [], [])


@pytest.mark.parametrize("name", MODULES)
def test_a_module_is_named_for_what_it_owns(name: str) -> None:
    assert not FORBIDDEN_NAMES & set(name.split("."))


@pytest.mark.parametrize("name", [name for name, path in MODULES.items() if path.read_text().strip()])
def test_a_module_says_what_it_is(name: str) -> None:
    assert ast.get_docstring(parsed(name))


def test_the_table_speaks_of_modules_that_exist() -> None:
    places = {*LAYERS, *(place for below in LAYERS.values() for place in below)}
    places |= {home for homes in HOMES.values() for home in homes}
    assert sorted(place for place in places if place not in MODULES) == []


def test_the_walk_sees_a_forbidden_import() -> None:
    found = [target for target, _ in imports(ast.parse("from graings.training import losses\nimport dbos"))]
    assert found == ["graings.training.losses", "dbos"]
    assert not allowed("service.app", "graings.training.losses")
    assert not allowed("graings.scene.scene", "graings.raster.rasterize")
    assert allowed("graings.render", "graings.raster.rasterize")
