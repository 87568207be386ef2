"""Who may know whom: docs/architecture.md as a table, checked on the syntax tree of every module."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("graings", "jobs", "service", "client")

# What everybody may use, whichever package it is in.
GROUND = (
    "graings",
    "graings.colmap",
    "graings.constants",
    "graings.document",
    "graings.errors",
    "graings.gaussians",
    "graings.image_encoding",
    "graings.random",
)

# A package, or a module of one, and which other packages it may import beside its own modules and the ground. The
# longest matching name decides.
LAYERS: dict[str, tuple[str, ...]] = {
    "graings": (),
    "graings.config": (),
    "graings.camera": (),
    "graings.kernel": (),
    "graings.capture": ("graings.camera", "graings.config"),
    "graings.footage": ("graings.capture.load", "graings.storage.files", "graings.storage.locks"),
    "graings.scene": ("graings.camera", "graings.config", "graings.kernel"),
    "graings.raster": ("graings.camera", "graings.kernel"),
    "graings.render": ("graings.camera", "graings.raster", "graings.scene"),  # they meet here and nowhere else
    "graings.matching": ("graings.camera", "graings.capture"),
    "graings.plan": ("graings.capture", "graings.config"),
    "graings.inspection": (
        *("graings.camera", "graings.capture", "graings.config", "graings.matching", "graings.plan"),
        *("graings.report.figure_files", "graings.scene.memory"),
    ),
    "graings.evaluation": ("graings.capture", "graings.render", "graings.scene"),
    "graings.storage": ("graings.camera", "graings.config", "graings.scene"),
    "graings.export": ("graings.camera", "graings.raster", "graings.render", "graings.scene", "graings.storage"),
    "graings.player": ("graings.camera", "graings.export", "graings.render", "graings.scene", "graings.storage"),
    "graings.report": (
        *(
            "graings.camera",
            "graings.capture",
            "graings.config",
            "graings.evaluation",
            "graings.kernel",
            "graings.plan",
        ),
        *("graings.raster", "graings.render", "graings.scene", "graings.storage"),
    ),
    "graings.training": (
        *(
            "graings.camera",
            "graings.capture",
            "graings.config",
            "graings.evaluation",
            "graings.kernel",
            "graings.matching",
            "graings.plan",
        ),
        *("graings.raster", "graings.render", "graings.report", "graings.scene", "graings.storage"),
    ),
    "graings.ablation": ("graings.capture", "graings.config", "graings.report", "graings.storage", "graings.training"),
    "graings.api": (
        *("graings.camera", "graings.capture", "graings.config", "graings.evaluation", "graings.export"),
        *("graings.kernel", "graings.player", "graings.render", "graings.report", "graings.storage"),
        "graings.training",
    ),
    "graings.cli": (
        *("graings.ablation", "graings.api", "graings.camera", "graings.capture", "graings.config"),
        "graings.evaluation",
        *("graings.export", "graings.footage", "graings.inspection", "graings.kernel", "graings.plan"),
        *("graings.player", "graings.render", "graings.report", "graings.storage", "graings.training"),
    ),
    # Durable work knows the method by its options and files; one child process trains.
    "jobs": (
        *("graings.config", "graings.document", "graings.report.events", "graings.storage.files"),
        *("graings.storage.locks", "graings.storage.run_folder"),
    ),
    "jobs.capture_phase": ("graings.capture.synthetic", "graings.footage", "jobs"),
    "jobs.task": ("graings.camera.view_request", "graings.export.camera_path", "graings.storage.files", "jobs"),
    "jobs.task_process": (
        *("graings.export", "graings.kernel", "graings.report.evaluate_run", "graings.storage.locks", "jobs"),
    ),
    "jobs.trainer_process": ("graings.config", "graings.report", "graings.storage", "graings.training", "jobs"),
    # What a program elsewhere uses: it knows nothing but HTTP.
    "client": (),
    # HTTP never trains.
    "service": (
        *("graings.camera", "graings.capture", "graings.config", "graings.evaluation", "graings.export"),
        *("graings.footage.source", "graings.inspection", "graings.kernel", "graings.plan", "graings.player"),
        *("graings.render", "graings.report", "graings.storage", "jobs"),
    ),
}

# Libraries with one home. The longest name decides here too.
HOMES: dict[str, tuple[str, ...]] = {
    "dbos": ("jobs.engine",),
    "fastapi": ("service",),
    "starlette": ("service",),
    "uvicorn": ("service",),
    "werkzeug": ("service.routes.render",),
    "limits": ("service.request_limits",),
    "prometheus_client": ("service",),
    "pythonjsonlogger": ("jobs.logs",),
    "httpx2": ("client", "jobs.webhooks"),
    "standardwebhooks": ("jobs.webhooks",),
    "PIL": ("client.calls",),
    "typer": ("graings.cli", "jobs.commands", "service.commands", "client.demo", "service.key_commands"),
    "rich": ("graings.cli", "jobs.commands", "service.commands", "client.demo", "service.key_commands"),
    "OpenImageIO": ("graings.capture", "graings.footage.photos", "graings.image_encoding"),
    "pycolmap": ("graings.capture", "graings.cli.doctor", "graings.colmap", "graings.footage", "graings.matching"),
    "lpips": ("graings.evaluation.perceptual",),
    "flip_evaluator": ("graings.evaluation.perceptual",),
    "matplotlib": ("graings.report", "graings.ablation.plot", "graings.inspection.picture"),
    "plyfile": ("graings.capture.readers.ply", "graings.export.ply"),
    "fourdgs": ("graings.export.four_d",),
    "gaussforge": ("graings.export.formats",),
    "av": ("graings.export", "graings.footage.video"),
    "safetensors": ("graings.storage.checkpoint", "graings.storage.compact"),
}

# Optional extras, and what takes long to import and is not always used.
MAY_BE_IMPORTED_LATE = {"av", "fourdgs", "gaussforge", "pycolmap", "lpips", "flip_evaluator", "matplotlib"}
MAY_BE_IMPORTED_LATE |= {"numpy", "PIL"}

FORBIDDEN_NAMES = {"util", "utils", "helper", "helpers", "manager", "misc", "common", "tools"}

# The two doors: the command line, and the names of the Python interface, which load at their first use.
DOORS = {"graings.__main__": "graings.cli", "graings": "graings.api"}

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


def row(name: str) -> str | None:
    """The row of the table for a module: the longest that fits; `graings` itself stands for its own file only."""
    if name in GROUND:
        return "graings"
    fitting = [key for key in LAYERS if within(name, key) and key != "graings"]
    return max(fitting, key=len, default=None)


def package(name: str) -> str:
    """The package of a module: `graings.scene`, `jobs`, `service`; a module in none is its own."""
    parts = name.split(".")
    return ".".join(parts[:2]) if parts[0] == "graings" else parts[0]


def allowed(name: str, target: str) -> bool:
    if name in DOORS:
        return within(target, DOORS[name])
    key = row(name)
    if key is None:
        return False
    if target in GROUND or package(name) == package(target):
        return True
    return any(within(target, place) for place in LAYERS[key])


def parsed(name: str) -> ast.Module:
    return ast.parse(MODULES[name].read_text(encoding="utf-8"))


def test_a_module_imports_only_from_layers_below() -> None:
    assert [name for name in MODULES if row(name) is None and name not in DOORS] == []
    wrong = [
        f"{name} imports {target} (line {line})"
        for name in MODULES
        for target, line in imports(parsed(name))
        if target.split(".")[0] in PACKAGES and not allowed(name, target)
    ]
    assert wrong == []


def test_the_layers_have_one_direction() -> None:
    below = {key: {package(place) for place in places} - {package(key)} for key, places in LAYERS.items()}
    remaining = {package(key): set[str]() for key in below}
    for key, places in below.items():
        remaining[package(key)] |= places
    while remaining:
        free = [key for key, places in remaining.items() if not places & remaining.keys()]
        assert free, f"these import each other: {sorted(remaining)}"
        for key in free:
            del remaining[key]


def test_a_library_with_one_home_is_imported_only_there() -> None:
    wrong = [
        f"{name} imports {target} (line {line})"
        for name in MODULES
        for target, line in imports(parsed(name))
        if (library := target.split(".")[0]) in HOMES and not any(within(name, home) for home in HOMES[library])
    ]
    assert wrong == []


def test_imports_are_absolute_named_and_at_the_top() -> None:
    wrong = []
    for name in MODULES:
        tree = parsed(name)
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom) and (node.level or any(alias.name == "*" for alias in node.names)):
                wrong.append(f"{name}, line {node.lineno}: relative or star")
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                wrong += [
                    f"{name}, line {line}: {target} inside a function"
                    for target, line in imports(node)
                    if target.split(".")[0] not in MAY_BE_IMPORTED_LATE
                ]
    assert wrong == []


def test_no_package_uses_a_private_name_of_another() -> None:
    wrong = []
    for name in MODULES:
        for node in ast.walk(parsed(name)):
            if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] in PACKAGES:
                wrong += [
                    f"{name}, line {node.lineno}: {node.module}.{alias.name}"
                    for alias in node.names
                    if alias.name.startswith("_") and node.module != name
                ]
    assert wrong == []


def test_a_module_is_named_for_what_it_owns() -> None:
    assert [name for name in MODULES if FORBIDDEN_NAMES & set(name.split("."))] == []


def test_a_module_says_what_it_is() -> None:
    empty = [name for name, path in MODULES.items() if not path.read_text().strip()]
    assert [name for name in MODULES if name not in empty and not ast.get_docstring(parsed(name))] == []


def test_no_module_is_longer_than_300_lines() -> None:
    lengths = {name: len(path.read_text().splitlines()) for name, path in MODULES.items()}
    assert {name: length for name, length in lengths.items() if length > 300} == {}


def test_a_class_name_exists_once() -> None:
    places: dict[str, list[str]] = {}
    for name in MODULES:
        for node in parsed(name).body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                places.setdefault(node.name, []).append(name)
    assert {name: found for name, found in places.items() if len(found) > 1} == {}


def test_the_top_of_graings_has_at_most_ten_modules() -> None:
    assert len(list((ROOT / "graings").glob("*.py"))) <= 10


def test_the_table_speaks_of_modules_that_exist() -> None:
    places = {*LAYERS, *GROUND, *(place for below in LAYERS.values() for place in below)}
    places |= {home for homes in HOMES.values() for home in homes}
    assert sorted(place for place in places if place not in MODULES) == []


def test_the_walk_sees_a_forbidden_import() -> None:
    found = [target for target, _ in imports(ast.parse("from graings.training import losses\nimport dbos"))]
    assert found == ["graings.training.losses", "dbos"]
    assert not allowed("service.app", "graings.training.losses")
    assert not allowed("graings.scene.scene", "graings.raster.rasterize")
    assert allowed("graings.render", "graings.raster.rasterize")
