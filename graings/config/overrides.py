"""Configurations from a preset with overrides or from a stored document, and the JSON Schema of all options."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final, TypeVar

from pydantic import ValidationError

from graings.config.presets import PRESETS
from graings.config.sections import ConfigSection
from graings.config.train_config import TrainConfig
from graings.errors import CheckpointError, ConfigError

MAX_DEPTH: Final = 8  # bounds the recursion; options have two levels

Stored = TypeVar("Stored", bound=ConfigSection)


def make_config(preset: str = "standard", overrides: dict[str, Any] | None = None) -> TrainConfig:
    """A preset with overrides, nested like the config or flat with dotted keys (`"loss.ssim": 0.1`).

    Raises `ConfigError` naming any field that is unknown or out of range.
    """
    overrides = dict(overrides or {})
    preset = str(overrides.pop("preset", preset))
    if preset not in PRESETS:
        raise ConfigError(f"preset: unknown preset {preset!r}. Choose one of {', '.join(PRESETS)}.")
    values: dict[str, Any] = {"preset": preset}
    _merge(values, overrides)
    try:
        return TrainConfig.model_validate(values)
    except ValidationError as error:
        raise ConfigError(f"{_problems(error)}. `graings options` lists every field with its bounds.") from error


def merged(*overrides: Mapping[str, Any]) -> dict[str, Any]:
    """Overrides as one, nested; of an option that several have, the last counts. Raises `ConfigError`."""
    values: dict[str, Any] = {}
    for each in overrides:
        _merge(values, each)
    return values


def restored(kind: type[Stored], values: Any, source: Path) -> Stored:
    """Options read from a stored file. Raises `CheckpointError` naming the file and the invalid fields."""
    try:
        return kind.model_validate(values)
    except ValidationError as error:
        raise CheckpointError(
            f"{source}: its options are not those of this version ({_problems(error)}). "
            "Use the version that wrote it, or train again."
        ) from error


def _problems(error: ValidationError) -> str:
    return "; ".join(f"{'.'.join(map(str, e['loc']))}: {e['msg']}" for e in error.errors())


def _merge(into: dict[str, Any], values: Mapping[str, Any], depth: int = 0) -> None:
    for key, value in values.items():
        head, _, rest = key.partition(".")
        if depth > MAX_DEPTH:
            raise ConfigError(
                f"{head[:40]}: an option name has at most {MAX_DEPTH} parts. `graings options` lists every field."
            )
        if rest:
            value = {rest: value}
        if isinstance(value, dict):
            child = into.setdefault(head, {})
            if not isinstance(child, dict):
                raise ConfigError(f"{head}: is a single value, not a section. `graings options` lists every field.")
            _merge(child, value, depth + 1)
        else:
            into[head] = value


def options() -> dict[str, Any]:
    """The JSON Schema of all options, with defaults, bounds and descriptions, and the values of every preset."""
    return {
        "schema": TrainConfig.model_json_schema(),
        "presets": {name: make_config(name).model_dump(mode="json") for name in PRESETS},
    }
