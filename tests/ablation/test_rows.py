"""Each row is the method with one design decision undone, in its options and in what is computed."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from graings.ablation.rows import METHOD, ROWS, chosen_rows, nothing_to_compare, row_config
from graings.config import PRESETS, ConfigSection, make_config
from graings.errors import ConfigError
from tests.models import EYE, tiny_scene

# Written out once more on purpose: what the names of the paper's tables mean here.
CHANGES = {
    "full": {},
    "no_stop_gradient": {"scene.stop_gradient": False},
    "no_l_temp": {"loss.temporal": 0.0},
    "no_l_def": {"loss.deformation": 0.0},
    "no_l_res": {"loss.residual": 0.0},
    "single_mlp": {"scene.single_mlp": True},
    "no_residual": {"scene.residual": False},
    "no_canonical": {"scene.canonical": False},
    "no_rigidity": {"loss.rigidity": 0.0},
    "anchor_deformation": {"scene.deformation": "anchor"},
}

# Differences to 36.982 dB in the paper's three tables.
PAPER = {
    "full": 0.0,
    "no_stop_gradient": -1.339,
    "no_l_temp": -0.768,
    "no_l_def": -0.521,
    "no_l_res": -0.335,
    "single_mlp": -0.781,
    "no_residual": -0.470,
    "no_canonical": -1.148,
    "no_rigidity": None,
    "anchor_deformation": None,
}


def flat(part: ConfigSection, prefix: str = "") -> dict[str, Any]:
    values: dict[str, Any] = {}
    for name in type(part).model_fields:
        value = getattr(part, name)
        values |= flat(value, f"{prefix}{name}.") if isinstance(value, ConfigSection) else {f"{prefix}{name}": value}
    return values


def test_the_switches_of_the_method_are_the_defaults() -> None:
    defaults = flat(make_config())
    assert {key: defaults[key] for key in METHOD} == METHOD


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.name)
def test_a_row_differs_from_the_full_model_only_as_its_name_says(row: Any) -> None:
    settings = {"iterations": 300, "capture": {"max_side": 32}}
    full, changed = (flat(row_config(one, "draft", settings, seed=4)) for one in (ROWS[0], row))
    assert {key: value for key, value in changed.items() if full[key] != value} == CHANGES[row.name]
    assert (changed["seed"], changed["iterations"], changed["capture.max_side"]) == (4, 300, 32)


def test_the_papers_differences_are_those_of_its_tables() -> None:
    assert {row.name: row.paper.difference if row.paper else None for row in ROWS} == PAPER


@pytest.mark.parametrize("form", [{"scene.residual": True}, {"scene": {"residual": True}}, {"scene.residual": "True"}])
def test_a_setting_that_contradicts_a_row_is_refused_and_one_that_agrees_is_not(form: dict[str, Any]) -> None:
    row = chosen_rows(["no_residual"])[0]
    with pytest.raises(ConfigError, match=r"scene\.residual.*no_residual.*--rows"):
        row_config(row, "draft", form, 0)
    row_config(ROWS[0], "draft", form, 0)


@pytest.mark.parametrize("preset", list(PRESETS))
def test_what_a_preset_sets_contradicts_no_row(preset: str) -> None:
    """Every row of a preset is what its name says, or equals the full model and says so."""
    for row in ROWS:
        if nothing_to_compare(row, preset, {}) is None:
            config = flat(row_config(row, preset, {}, 0))
            assert {key: config[key] for key in row.options} == row.options


def test_the_users_weight_of_a_loss_is_that_of_the_rows_that_have_it() -> None:
    settings = {"loss": {"temporal": 0.02}}
    temporal = [row_config(row, "draft", settings, 0).loss.temporal for row in chosen_rows(["full", "no_l_temp"])]
    assert temporal == [0.02, 0.0]


@pytest.mark.parametrize(
    ("name", "key"),
    [("no_l_temp", "loss.temporal"), ("no_l_def", "loss.deformation"), ("no_residual", "scene.residual_scale")],
)
def test_a_row_that_would_be_the_full_model_over_again_is_refused(name: str, key: str) -> None:
    with pytest.raises(ConfigError, match=rf"{key}: is 0.*{name}"):
        row_config(chosen_rows([name])[0], "draft", {key: 0}, 0)


def test_rigidity_between_the_views_of_a_step_needs_two() -> None:
    with pytest.raises(ConfigError, match=r"batch: is 1.*no_rigidity.*--rows"):
        row_config(chosen_rows(["no_rigidity"])[0], "long", {}, 0)


def test_a_seed_among_the_settings_is_refused() -> None:
    with pytest.raises(ConfigError, match="--seeds"):
        row_config(ROWS[0], "draft", {"seed": 0}, 0)


def test_rows_come_in_the_order_of_the_table_and_an_unknown_one_is_named() -> None:
    assert [row.name for row in chosen_rows(["no_l_def", "full", "full"])] == ["full", "no_l_def"]
    assert chosen_rows([]) == ROWS
    with pytest.raises(ConfigError, match=r"'no_colour'.*full, no_stop_gradient"):
        chosen_rows(["full", "no_colour"])


def _model(name: str) -> Any:
    config = row_config(chosen_rows([name])[0], "draft", {}, 0).scene
    options = {key.removeprefix("scene."): value for key, value in CHANGES[name].items() if key.startswith("scene.")}
    assert all(getattr(config, key) == value for key, value in options.items())
    return tiny_scene(**options)


def _reached_by_motion(name: str) -> bool:
    """Whether a gradient on the offsets in time reaches where the children lie."""
    scene = _model(name)
    composition = scene.compose(EYE, 0.4)
    assert composition.position_offsets is not None
    composition.position_offsets.square().sum().backward()
    gradient = scene.scaffold.offsets.grad
    return gradient is not None and bool(gradient.abs().max() > 0)


def test_only_without_stop_gradient_does_motion_pull_at_the_canonical_positions() -> None:
    assert _reached_by_motion("no_stop_gradient")
    assert not _reached_by_motion("full")


@pytest.mark.parametrize(("name", "shared"), [("full", False), ("anchor_deformation", True)])
def test_only_deformation_per_anchor_moves_all_children_of_an_anchor_alike(name: str, shared: bool) -> None:
    scene = _model(name)
    with torch.no_grad():
        composition = scene.compose(EYE, 0.4)
    assert composition.position_offsets is not None
    owners = composition.children // scene.scaffold.slots
    siblings = owners[1:] == owners[:-1]
    assert siblings.any()
    steps = composition.position_offsets.diff(dim=0).abs().amax(-1)[siblings]
    assert bool((steps == 0).all()) is shared


def test_the_parts_that_a_row_takes_away_are_gone() -> None:
    assert _model("no_residual").residual is None
    assert _model("no_canonical").static is None
    single = _model("single_mlp")
    assert (single.static, single.deformation) == (None, None)
    assert single.single is not None
