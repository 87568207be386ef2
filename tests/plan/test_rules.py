"""What the plan leaves out, the scene that just violates each condition, and options that decide otherwise."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from graings.capture.synthetic import write_synthetic
from graings.config import make_config
from graings.plan.capture_statistics import CaptureStatistics, TileChange
from graings.plan.decision import Condition
from graings.plan.plan import Plan, make_plan
from tests.plan.fixed_cameras import noisy, square, statistics_of, texture, write_fixed

AGGRESSIVE = {"plan.mode": "aggressive"}
STILL = TileChange(ratio=1.0, value=0.0, image="a.png", tile=(0, 0), px=64)
FACTS = CaptureStatistics(
    images=24,
    examined=24,
    times=8,
    cameras=3,
    camera_motion="fixed",
    simultaneous=3,
    width=64,
    height=64,
    pixels=4096,
    noise=0.0,
    gain=(1.0, 1.0),
    offset=0.0,
    change=STILL,
    alpha="varying",
    points=0,
    distorted=0,
    coverage=0.5,
    detail=0.1,
    cost_s=0.1,
)
MONOCULAR = {"camera_motion": "moving", "change": None, "gain": None, "offset": None, "cameras": 24, "simultaneous": 1}


def plan_of(facts: dict[str, Any] | None = None, **options: object) -> Plan:
    return make_plan(FACTS.model_copy(update=facts or {}), make_config(overrides={"preset": "draft", **options}))


def verdict(plan: Plan, component: Any) -> tuple[str, str]:
    decision = plan.decision(component)
    assert decision is not None
    return decision.decision, decision.kind


def test_one_time_needs_neither_deformation_nor_residual_nor_temporal_loss(tmp_path: Path) -> None:
    """D05, from files."""
    folder = write_fixed(tmp_path, lambda c, t: texture(16), cameras=6, times=1, size=16)
    config = make_config("draft")
    plan = make_plan(statistics_of(folder), config)
    assert verdict(plan, "deformation") == verdict(plan, "residual") == ("drop", "representable")
    assert verdict(plan, "temporal_loss") == verdict(plan, "rigidity") == ("drop", "exact")
    applied = plan.apply(config)
    assert (applied.scene.deformation, applied.scene.residual, applied.loss.temporal) == ("none", False, 0.0)
    first, last = config.rates.offsets
    assert applied.rates.offsets == (2 * first, last)
    assert plan.apply(applied) == applied
    left_out = make_config("draft", {"scene.deformation": "none"})
    assert make_plan(statistics_of(folder), left_out).apply(left_out).rates == config.rates  # of a user: as asked for
    reason = plan.decision("deformation")
    assert reason is not None
    assert "1 distinct training time" in reason.reason


def test_a_rate_that_was_set_is_not_doubled() -> None:
    config = make_config("draft", {"rates.offsets": (0.01, 1e-3)})
    plan = make_plan(FACTS.model_copy(update={"times": 1}), config)
    assert plan.apply(config).scene.deformation == "none"
    assert plan.apply(config).rates == config.rates
    decision = plan.decision("deformation")
    assert decision is not None
    assert "rate" not in decision.reason


@pytest.mark.parametrize(
    ("component", "option"),
    [("temporal_loss", "loss.temporal"), ("rigidity", "loss.rigidity"), ("alpha_loss", "loss.alpha")],
)
def test_a_loss_that_is_switched_off_is_the_users_decision(component: Any, option: str) -> None:
    decision = plan_of(**{option: 0.0}).decision(component)
    assert decision is not None
    assert (decision.decision, decision.kind, decision.reason) == ("drop", "user", f"{option} is 0")


def test_a_scene_without_deformation_has_no_temporal_loss_because_nothing_moves() -> None:
    decision = plan_of(**{"scene.deformation": "none"}).decision("temporal_loss")
    assert decision is not None
    assert (decision.decision, decision.reason, decision.condition) == ("drop", "nothing moves", None)


@pytest.mark.parametrize("times", [1, 8])
def test_one_network_for_shape_and_motion_keeps_the_motion(times: int) -> None:
    """The deformation is that network: there is nothing to leave out, and the schedule has both phases."""
    config = make_config("draft", {"scene.single_mlp": True})
    plan = make_plan(FACTS.model_copy(update={"times": times}), config)
    assert verdict(plan, "deformation") == ("keep", "user")
    applied = plan.apply(config)
    assert (applied.scene.deformation, applied.rates.offsets) == ("child", config.rates.offsets)
    assert verdict(plan, "temporal_loss")[0] == ("drop" if times == 1 else "keep")


def test_two_times_keep_them() -> None:
    """The counter-scene of the test above."""
    plan = plan_of({"times": 2, **MONOCULAR})
    assert verdict(plan, "deformation")[0] == "keep"
    assert verdict(plan, "residual") == ("later", "bounded")
    assert verdict(plan, "temporal_loss")[0] == "keep"
    config = make_config("draft")
    assert plan.apply(config) == config


def test_a_moving_camera_keeps_the_deformation_and_says_why() -> None:
    """PT5."""
    plan = plan_of(MONOCULAR, **AGGRESSIVE)
    assert verdict(plan, "deformation")[0] == "keep"
    assert any("cannot be told" in warning for warning in plan.warnings)


@pytest.mark.parametrize(("mode", "decision"), [("safe", "propose"), ("aggressive", "drop"), ("off", "keep")])
def test_fixed_cameras_that_see_no_change_propose_to_drop_motion(tmp_path: Path, mode: str, decision: str) -> None:
    folder = write_fixed(tmp_path, lambda c, t: noisy(texture(), 0.01, c, t), cameras=3)
    config = make_config("draft", {"plan.mode": mode})
    plan = make_plan(statistics_of(folder), config)
    found = plan.decision("deformation")
    assert found is not None
    assert found.decision == decision
    assert (plan.apply(config).scene.deformation == "none") == (mode == "aggressive")


def test_one_small_mover_keeps_the_motion_even_if_aggressive(tmp_path: Path) -> None:
    """The counter-scene: a square of 4 px moves in one camera."""

    def draw(camera: int, index: int) -> Any:
        return noisy(square(texture(), 20 + index, 30, 4, (1, 1, 1)) if camera == 2 else texture(), 0.01, camera, index)

    plan = make_plan(statistics_of(write_fixed(tmp_path, draw, cameras=3)), make_config("draft", AGGRESSIVE))
    assert verdict(plan, "deformation") == ("keep", "estimated")
    assert verdict(plan, "residual") == ("later", "bounded")


def test_a_change_just_above_the_noise_keeps_the_motion() -> None:
    above = STILL.model_copy(update={"ratio": 1.0 + 1e-6})
    assert verdict(plan_of(**AGGRESSIVE), "deformation")[0] == "drop"
    assert verdict(plan_of({"change": above}, **AGGRESSIVE), "deformation")[0] == "keep"


def test_flicker_leaves_the_deformation_testable_and_keeps_the_residual() -> None:
    """PT6."""
    plan = plan_of({"gain": (0.97, 1.03)}, **AGGRESSIVE)
    assert verdict(plan, "deformation") == ("drop", "estimated")
    assert verdict(plan, "residual") == ("later", "bounded")
    assert verdict(plan_of(**AGGRESSIVE), "residual") == ("drop", "estimated")


@pytest.mark.parametrize(
    ("facts", "decision"),
    [
        ({"alpha": "absent"}, "drop"),
        ({"alpha": "opaque"}, "drop"),
        ({"alpha": "opaque", "examined": 23}, "keep"),  # the 24th image may have a hole
        ({"alpha": "varying"}, "keep"),  # PT15: an image with alpha 0 everywhere counts
    ],
)
def test_the_alpha_loss_goes_only_where_no_image_has_alpha(facts: dict[str, Any], decision: str) -> None:
    assert verdict(plan_of(facts), "alpha_loss") == (decision, "exact")


@pytest.mark.parametrize(("component", "fact"), [("undistortion", "distorted"), ("random_points", "points")])
def test_what_the_reader_does_follows_the_capture(component: str, fact: str) -> None:
    assert verdict(plan_of({fact: 0}), component)[0] != verdict(plan_of({fact: 5}), component)[0]


def test_off_leaves_nothing_out() -> None:
    config = make_config("draft", {"plan.mode": "off"})
    plan = make_plan(FACTS.model_copy(update={"times": 1, "alpha": "opaque"}), config)
    applied = plan.apply(config)
    assert (applied.scene, applied.loss.alpha) == (config.scene, config.loss.alpha)


@pytest.mark.parametrize(
    ("facts", "options", "number"),
    [
        ({"times": 1}, {"plan.keep": ["deformation"]}, "distinct training times 1 = 1"),
        ({"times": 1}, {"plan.keep": ["residual"]}, "distinct training times 1 = 1"),
        ({}, {"plan.keep": ["deformation"]}, "1 ≤ 1"),
        ({"change": STILL.model_copy(update={"ratio": 310.0})}, {"scene.deformation": "none"}, "310 > 1"),
        ({"alpha": "absent"}, {"plan.keep": ["alpha_loss"]}, "alpha is absent"),
    ],
)
def test_an_option_against_a_measurement_is_obeyed_and_warned_of(
    facts: dict[str, Any], options: dict[str, Any], number: str
) -> None:
    config = make_config("draft", options)
    plan = make_plan(FACTS.model_copy(update=facts), config)
    assert [warning for warning in plan.warnings if number in warning]
    kept = options.get("plan.keep", ["nothing"])[0]
    assert not plan.drops(kept) if kept != "nothing" else plan.drops("deformation")


def test_images_of_one_colour_are_warned_of() -> None:
    (warning,) = plan_of({"coverage": 0.0}).warnings
    assert "show one colour and nothing else" in warning


def test_no_warning_without_a_contradiction() -> None:
    assert plan_of().warnings == ()
    assert plan_of({"times": 1}).warnings == ()


def test_every_dropped_part_says_how_to_keep_it_or_is_exact() -> None:
    for facts in ({"times": 1}, {}, MONOCULAR, {"alpha": "absent", "points": 9}):
        for decision in plan_of(facts, **AGGRESSIVE).decisions:
            free = decision.kind in ("exact", "user") or decision.component == "random_points"
            assert decision.decision != "drop" or free or decision.override


@pytest.mark.parametrize("options", [{}, AGGRESSIVE])
def test_the_options_that_decide_otherwise_do_so(options: dict[str, Any]) -> None:
    for facts in ({"times": 1}, {}, MONOCULAR, {"alpha": "absent", "points": 9}):
        for decision in plan_of(facts, **options).decisions:
            if decision.override is None or decision.decision == "keep":
                continue
            other = plan_of(facts, **{**options, **decision.override}).decision(decision.component)
            assert other is not None
            assert other.decision in ({"propose": ("drop", "keep")}.get(decision.decision, ("keep",))), decision


def test_a_plan_survives_its_file() -> None:
    plan = plan_of({"times": 1})
    assert Plan.model_validate(plan.to_json()) == plan


@pytest.mark.parametrize(
    ("op", "value", "holds"),
    [("==", 1, True), ("==", 2, False), ("<=", 1, True), ("<", 1, False), (">=", 1, True), (">", 1, False)],
)
def test_a_condition_compares(op: Any, value: float, holds: bool) -> None:
    assert Condition(name="x", op=op, value=value, threshold=1).holds is holds
    assert not Condition(name="x", op=op, value=None, threshold=1).holds


def test_a_longer_training_is_proposed_for_much_detail_and_never_a_draft_for_what_moves(tmp_path: Path) -> None:
    rich, poor = {"detail": 0.5, "pixels": 160_000}, {"detail": 0.001}
    assert [d.override for d in plan_of(rich).decisions if d.component == "preset"] == [{"preset": "fine"}]
    assert verdict(plan_of({**poor, "times": 1}), "preset")[0] == "keep"
    assert [d.override for d in plan_of(poor).decisions if d.component == "preset"] == [{"preset": "standard"}]
    assert verdict(
        make_plan(statistics_of(write_synthetic(tmp_path / "c", frames=6, size=24)), make_config()), "preset"
    )
