"""Rules: what decides about each component. Pure functions of the statistics of a capture and the options."""

from __future__ import annotations

from typing import Final

from graings.config import PRESETS, Part, TrainConfig, make_config
from graings.plan.capture_statistics import CaptureStatistics
from graings.plan.cost import expected_anchors
from graings.plan.decision import Bound, Component, Condition, Decision, Kind
from graings.plan.tile_change import HALF_LEVEL

NO_ALPHA: Final = "the images have no alpha channel"
MONOCULAR: Final = "a moving camera sees every time once: whether objects move cannot be told from the images"

# Joint iterations, in a schedule of 30 000, before which training does not judge the residual: it begins at zero.
RESIDUAL_FROM: Final = 2_000

# Growths without a new anchor after which nothing more is expected to grow.
QUIET_GROWTHS: Final = 5

# Expected anchors above which a longer training is proposed, and up to which a draft has enough of them for one time.
RICH: Final = 3_500
POOR: Final = PRESETS["draft"]["density"]["max_anchors"]


def decide(statistics: CaptureStatistics, config: TrainConfig) -> list[Decision]:
    """One decision per component."""
    deformation, residual = _deformation(statistics, config), _residual(statistics, config)
    static = statistics.times == 1 or deformation.decision == "drop"
    return [
        deformation,
        residual,
        _view_dependence(statistics, config),
        _temporal_loss(statistics, config, static),
        _rigidity(statistics, config, static),
        _alpha_loss(statistics, config),
        _given("random_points", statistics.points > 0, "points in the capture's cloud", statistics.points, ">"),
        _carving(statistics),
        _given("undistortion", statistics.distorted == 0, "images with a distorting lens", statistics.distorted, "=="),
        _growth(config),
        _preset(statistics, config),
    ]


def has_preset_rate(config: TrainConfig) -> bool:
    """Whether the child offsets have the rate of the preset: one that was set is the user's decision."""
    return config.rates.offsets == make_config(config.preset).rates.offsets


def _kept(config: TrainConfig, part: Part) -> bool:
    return config.plan.mode == "off" or part in config.plan.keep


def _kept_by_option(config: TrainConfig, part: Part, condition: Condition | None) -> Decision:
    option = "plan.mode is off" if config.plan.mode == "off" else f"plan.keep has {part}"
    return Decision(component=part, decision="keep", kind="user", reason=option, condition=condition)


def single_time(statistics: CaptureStatistics) -> Condition:
    """That the training views show one instant."""
    return Condition(name="distinct training times", op="==", value=statistics.times, threshold=1)


def unchanged(statistics: CaptureStatistics) -> Condition:
    """That no tile of a fixed camera changes between times."""
    ratio = None if statistics.change is None else statistics.change.ratio
    return Condition(name="largest change of a tile over what noise explains", op="<=", value=ratio, threshold=1)


def _deformation(statistics: CaptureStatistics, config: TrainConfig) -> Decision:
    one, still = single_time(statistics), unchanged(statistics)
    if config.scene.deformation == "none":
        reason = "scene.deformation is none"
        return Decision(component="deformation", decision="drop", kind="user", reason=reason, condition=still)
    if config.scene.single_mlp:
        reason = "scene.single_mlp: the network of the shape moves it too"
        return Decision(component="deformation", decision="keep", kind="user", reason=reason, condition=one)
    if _kept(config, "deformation"):
        return _kept_by_option(config, "deformation", one if one.holds else still)
    if one.holds:
        reason = "1 distinct training time: the canonical state is all there is"
        reason += "; offsets start at twice their rate" if has_preset_rate(config) else ""
        return _dropped("deformation", "representable", reason, one)
    if statistics.change is None:
        reason = MONOCULAR if statistics.camera_motion != "fixed" else "not every fixed camera could be looked at"
        return Decision(component="deformation", decision="keep", kind="representable", reason=reason, condition=one)
    if still.holds:
        return _estimated(config, "deformation", "no tile of any fixed camera changes between times", still)
    change = statistics.change
    reason = f"tile {change.tile[0]},{change.tile[1]} of {change.image} changes by {255 * change.value:.3g} grey levels"
    return Decision(component="deformation", decision="keep", kind="estimated", reason=reason, condition=still)


def _residual(statistics: CaptureStatistics, config: TrainConfig) -> Decision:
    one, still = single_time(statistics), unchanged(statistics)
    if not config.scene.residual:
        return Decision(component="residual", decision="drop", kind="user", reason="scene.residual is off")
    if _kept(config, "residual"):
        return _kept_by_option(config, "residual", one)
    if one.holds:
        reason = "1 distinct training time: the canonical colour can be any colour"
        return _dropped("residual", "representable", reason, one)
    low, high = statistics.gain or (0.0, 0.0)
    steady = statistics.gain is not None and max(1 - low, high - 1, statistics.offset or 0.0) <= HALF_LEVEL
    if still.holds and steady:
        return _estimated(config, "residual", "no tile of any fixed camera changes between times, nor its gain", still)
    first = config.scaled(config.warmup) + config.scaled(RESIDUAL_FROM)
    condition = Condition(
        name="its rendered bound at two evaluations",
        op="<=",
        value=None,
        threshold=255 * HALF_LEVEL,
        unit="grey levels",
    )
    reason = f"left out if it changes no training view by half a grey level, judged from iteration {first:,} on"
    bound = Bound(value=HALF_LEVEL, how="rendered at all training views and times, after training has looked")
    return Decision(
        component="residual",
        decision="later",
        kind="bounded",
        reason=reason,
        condition=condition,
        bound=bound,
        iteration=first,
        override={"plan.keep": ["residual"]},
    )


def _view_dependence(statistics: CaptureStatistics, config: TrainConfig) -> Decision:
    reason = "a highlight and a change over time look alike where every time is seen once"
    if statistics.simultaneous > 1:
        reason = "telling a highlight from an edge needs the geometry, which only training finds"
    off = " (the residual of this preset has none)" if config.scene.residual_sh_degree == 0 else ""
    return Decision(
        component="view_dependence",
        decision="keep",
        kind="estimated",
        reason=f"{reason}{off}",
        condition=Condition(
            name="loss of PSNR with the colours of another view", op="<=", value=None, threshold=0.05, unit="dB"
        ),
        override={"scene.residual_sh_degree": 0, "scene.reflection": False, "scene.color_sh_degree": 1},
    )


def _temporal_loss(statistics: CaptureStatistics, config: TrainConfig, static: bool) -> Decision:
    if config.loss.temporal == 0:
        return Decision(component="temporal_loss", decision="drop", kind="user", reason="loss.temporal is 0")
    one = single_time(statistics)
    if static:
        return _dropped(
            "temporal_loss", "exact", *(("no pair of times", one) if one.holds else ("nothing moves", None))
        )
    reason = f"{statistics.times} distinct training times"
    return Decision(component="temporal_loss", decision="keep", kind="exact", reason=reason, condition=one)


def _rigidity(statistics: CaptureStatistics, config: TrainConfig, static: bool) -> Decision:
    if config.loss.rigidity == 0:
        return Decision(component="rigidity", decision="drop", kind="user", reason="loss.rigidity is 0")
    views = min(config.batch, statistics.images)
    condition = Condition(name="views in a step", op="==", value=views, threshold=1)
    reason = "nothing moves" if static else "one view per step" if views == 1 else "neighbours move together"
    if static or views == 1:
        return _dropped("rigidity", "exact", reason, None if static else condition)
    return Decision(component="rigidity", decision="keep", kind="exact", reason=reason, condition=condition)


def _alpha_loss(statistics: CaptureStatistics, config: TrainConfig) -> Decision:
    if config.loss.alpha == 0:
        return Decision(component="alpha_loss", decision="drop", kind="user", reason="loss.alpha is 0")
    if _kept(config, "alpha_loss"):
        return _kept_by_option(config, "alpha_loss", None)
    looked = Condition(name="images looked at", op="==", value=statistics.examined, threshold=statistics.images)
    if statistics.alpha == "absent":
        return _dropped("alpha_loss", "exact", NO_ALPHA, None)
    if statistics.alpha == "opaque" and looked.holds:
        return _dropped("alpha_loss", "exact", "the alpha channel is 1 everywhere in all images", looked)
    if statistics.alpha == "opaque":
        reason = f"alpha is 1 in the images looked at, but these were {looked.value:g} of {looked.threshold:g}"
        return Decision(component="alpha_loss", decision="keep", kind="exact", reason=reason, condition=looked)
    return Decision(component="alpha_loss", decision="keep", kind="exact", reason="the masks show what is opaque")


def _given(component: Component, unneeded: bool, name: str, value: int, op: str) -> Decision:
    """A step that is done only where the capture calls for it."""
    condition = Condition.model_validate({"name": name, "op": op, "value": value, "threshold": 0})
    reasons: dict[Component, tuple[str, str]] = {
        "random_points": ("the capture has a point cloud", "the capture has no point cloud"),
        "undistortion": ("no lens distorts", "photographs are undistorted when they are decoded"),
    }
    reason = reasons[component][0 if unneeded else 1]
    kind: Kind = "representable" if component == "random_points" else "exact"
    verdict = "drop" if unneeded else "keep"
    return Decision.model_validate(
        {"component": component, "decision": verdict, "kind": kind, "reason": reason, "condition": condition}
    )


def _carving(statistics: CaptureStatistics) -> Decision:
    if statistics.points:
        return _dropped("carving", "exact", "no random points", None)
    reason = "background pixels" if statistics.alpha != "varying" else "the masks"
    return Decision(component="carving", decision="keep", kind="exact", reason=f"{reason} show empty space")


def _growth(config: TrainConfig) -> Decision:
    if _kept(config, "growth"):
        return _kept_by_option(config, "growth", None)
    condition = Condition(name="successive growths without a new anchor", op=">=", value=None, threshold=QUIET_GROWTHS)
    aggressive = config.plan.mode == "aggressive"
    then = "growth and its statistics end" if aggressive else "training reports it, and goes on"
    return Decision(
        component="growth",
        decision="later" if aggressive else "keep",
        kind="estimated",
        reason=f"after {QUIET_GROWTHS} growths without a new anchor {then}",
        condition=condition,
        iteration=config.scaled(config.density.grow_from) if aggressive else None,
        override={"plan.keep": ["growth"]} if aggressive else {"plan.mode": "aggressive"},
    )


def _preset(statistics: CaptureStatistics, config: TrainConfig) -> Decision:
    anchors = expected_anchors(statistics)
    proposed = "fine" if anchors > RICH else "draft" if statistics.times == 1 and anchors <= POOR else "standard"
    condition = Condition(
        name="anchors that this detail asks for",
        op="<=" if proposed == "draft" else ">",
        value=anchors,
        threshold=POOR if proposed == "draft" else RICH,
    )
    reason = {
        "fine": "much detail gains from more steps",
        "standard": "no more detail than usual",
        "draft": "one time and little detail",
    }[proposed]
    same = proposed == config.preset
    return Decision(
        component="preset",
        decision="keep" if same else "propose",
        kind="estimated",
        reason=f"{reason}: {proposed}" + ("" if same else f" instead of {config.preset}"),
        condition=condition,
        override={"preset": proposed},
    )


def _dropped(component: Component, kind: Kind, reason: str, condition: Condition | None) -> Decision:
    bound = Bound(value=0.0, how="the same computation" if kind == "exact" else "the other parts reach the same images")
    override = {"plan.keep": [component]} if component in ("deformation", "residual", "alpha_loss") else None
    return Decision(
        component=component,
        decision="drop",
        kind=kind,
        reason=reason,
        condition=condition,
        bound=bound,
        override=override,
    )


def _estimated(config: TrainConfig, part: Part, reason: str, condition: Condition) -> Decision:
    """A part that measurements suggest to leave out: proposed, or dropped with `plan.mode=aggressive`."""
    aggressive = config.plan.mode == "aggressive"
    return Decision(
        component=part,
        decision="drop" if aggressive else "propose",
        kind="estimated",
        reason=reason,
        condition=condition,
        override={"plan.keep": [part]} if aggressive else {"plan.mode": "aggressive"},
    )
