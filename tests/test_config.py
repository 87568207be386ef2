"""Options: invalid values are refused with the name of the field."""

from __future__ import annotations

from typing import Any

import pytest

from graings.config import PRESETS, TrainConfig, make_config
from graings.config.overrides import MAX_DEPTH
from graings.errors import ConfigError


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("capture.background", (5.0, 0.0, 0.0)),
        ("capture.background", (0.0, -1.0, 0.0)),
        ("capture.background", (1e300, 0.0, 0.0)),
        ("rates.offsets", (-1.0, 1.0)),
        ("rates.matrices", (1e-3, -1e-5)),
        ("init.voxel_size", 1e-30),
        ("loss.rigidity", -0.1),
        ("iterations", 0),
        ("warmup", 30_000),
        ("time_window_until", 30_001),
        ("low_resolution_until", 30_001),
        ("loss.ssim", float("nan")),
    ],
)
def test_a_value_outside_its_bounds_is_refused_by_name(key: str, value: Any) -> None:
    with pytest.raises(ConfigError, match=key.replace(".", r"\.")):
        make_config("draft", {key: value})


def test_one_network_for_shape_and_motion_needs_motion() -> None:
    with pytest.raises(ConfigError, match=r"scene.*single_mlp moves the Gaussians.*Set one only"):
        make_config("draft", {"scene.single_mlp": True, "scene.deformation": "none"})


def nested(depth: int) -> dict[str, Any]:
    value: dict[str, Any] = {"a": 1}
    for _ in range(depth):
        value = {"a": value}
    return value


@pytest.mark.parametrize("settings", [{"a." * 3_000 + "a": 1}, nested(900)])
def test_overrides_nested_deeper_than_any_option_are_refused_before_the_recursion_limit(
    settings: dict[str, Any],
) -> None:
    with pytest.raises(ConfigError, match="graings options"):
        make_config("draft", settings)


def test_every_option_is_less_deep_than_the_limit() -> None:
    def depth(value: Any) -> int:
        return 1 + max(map(depth, value.values()), default=0) if isinstance(value, dict) else 0

    assert depth(make_config().model_dump()) < MAX_DEPTH


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ({"iterations": {}}, "iterations: Input should be a valid integer"),
        ({"iterations.a": 1}, "iterations: Input should be a valid integer"),
        ({"iterations": 5, "iterations.a": 1}, "iterations: is a single value, not a section"),
    ],
)
def test_a_single_value_is_not_a_section(overrides: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        make_config("draft", overrides)


@pytest.mark.parametrize("name", PRESETS)
def test_a_preset_has_its_values_however_the_configuration_is_made(name: str) -> None:
    """The name of a preset never stands over the values of another one."""
    made = make_config(name)
    assert TrainConfig.model_validate({"preset": name}) == made
    assert TrainConfig.model_validate(made.model_dump(mode="json")) == made
    changed = TrainConfig.model_validate({"preset": name, "scene": {"children": 3}, "iterations": 7})
    assert changed == make_config(name, {"scene.children": 3, "iterations": 7})
