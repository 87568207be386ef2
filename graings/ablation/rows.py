"""Rows: the models an ablation compares, what each changes, and what the paper measured for it.

A row is the method with one design decision undone. Every row sets all switches, so that two rows differ only in what
their names say.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

from graings.config import TrainConfig, make_config, merged
from graings.errors import ConfigError

# The switches as the method sets them.
METHOD: Final[Mapping[str, Any]] = {
    "scene.stop_gradient": True,
    "scene.deformation": "child",
    "scene.single_mlp": False,
    "scene.residual": True,
    "scene.canonical": True,
}

FULL: Final = "full"
SCENES: Final = "mean over the eight D-NeRF scenes, 30 000 iterations"


@dataclass(frozen=True, slots=True)
class PaperResult:
    """What the paper reports for a row: PSNR in dB, SSIM and LPIPS of the mean over D-NeRF, and in which table."""

    psnr: float
    ssim: float
    lpips: float
    table: str

    @property
    def difference(self) -> float:
        """PSNR above the paper's full model, dB (negative where the row is worse)."""
        return round(self.psnr - PAPER_FULL.psnr, 3)


PAPER_FULL: Final = PaperResult(36.982, 0.9871, 0.0136, "ablation_stopgrad")


@dataclass(frozen=True, slots=True)
class Row:
    """One model of the comparison.

    `changes` are the options in which it differs from the method, by dotted name; `needs` are options that must exceed
    these numbers for the row to differ from the full model at all; `paper` is None where the paper has no number.
    """

    name: str
    label: str
    changes: Mapping[str, Any] = field(default_factory=dict)
    needs: Mapping[str, float] = field(default_factory=dict)
    paper: PaperResult | None = None

    @property
    def options(self) -> dict[str, Any]:
        """Every switch with its value in this row."""
        return {**METHOD, **self.changes}


ROWS: Final[tuple[Row, ...]] = (
    Row(FULL, "full", paper=PAPER_FULL),
    Row(
        "no_stop_gradient",
        "without stop-gradient",
        {"scene.stop_gradient": False},
        paper=PaperResult(35.643, 0.9812, 0.0253, "ablation_stopgrad"),
    ),
    Row(
        "no_l_temp",
        "without L_temp",
        {"loss.temporal": 0.0},
        needs={"loss.temporal": 0},
        paper=PaperResult(36.214, 0.9829, 0.0167, "ablation_loss"),
    ),
    Row(
        "no_l_def",
        "without L_def",
        {"loss.deformation": 0.0},
        needs={"loss.deformation": 0},
        paper=PaperResult(36.461, 0.9856, 0.0154, "ablation_loss"),
    ),
    Row(
        "no_l_res",
        "without L_res",
        {"loss.residual": 0.0},
        needs={"loss.residual": 0, "scene.residual_scale": 0},
        paper=PaperResult(36.647, 0.9861, 0.0148, "ablation_loss"),
    ),
    Row(
        "single_mlp",
        "single MLP",
        {"scene.single_mlp": True},
        paper=PaperResult(36.201, 0.9836, 0.0198, "ablation"),
    ),
    Row(
        "no_residual",
        "without residual",
        {"scene.residual": False},
        needs={"scene.residual_scale": 0},
        paper=PaperResult(36.512, 0.9854, 0.0162, "ablation"),
    ),
    Row(
        "no_canonical",
        "without canonical",
        {"scene.canonical": False},
        paper=PaperResult(35.834, 0.9812, 0.0221, "ablation"),
    ),
    Row("no_rigidity", "without rigidity", {"loss.rigidity": 0.0}, needs={"loss.rigidity": 0, "batch": 1}),
    Row("anchor_deformation", "deformation per anchor", {"scene.deformation": "anchor"}),
)


def chosen_rows(names: Sequence[str]) -> tuple[Row, ...]:
    """The rows of these names, each once, in the order of `ROWS`; all of them for no names.

    Raises `ConfigError` naming a row that does not exist.
    """
    known = [row.name for row in ROWS]
    unknown = [name for name in names if name not in known]
    if unknown:
        raise ConfigError(f"rows: there is no row {unknown[0]!r}. Choose from {', '.join(known)}.")
    return tuple(row for row in ROWS if not names or row.name in names)


def row_config(row: Row, preset: str, settings: Mapping[str, Any], seed: int) -> TrainConfig:
    """The options of one run: `preset`, then the user's `settings` (dotted or nested), then those of `row`.

    Raises `ConfigError` for settings that contradict the row, or that leave it no different from the full model.
    """
    same = nothing_to_compare(row, preset, settings)
    if same is not None:
        raise ConfigError(f"{same} Raise it, or leave the row out (--rows).")
    given, config = dotted(merged(settings)), make_config(preset, dict(settings))
    if "seed" in given:
        raise ConfigError("seed: an ablation gives every row the same seeds. Leave it out and use --seeds.")
    # Loss weights are not compared: the user's is that of the other rows.
    for key in METHOD:
        if key in given and _option(config, key) != row.options[key]:
            raise ConfigError(
                f"{key}: is set to {_option(config, key)!r}, but the row {row.name} is {row.options[key]!r} there. "
                "Leave the setting out, or name the rows that agree with it (--rows)."
            )
    return combined(row, preset, settings, seed)


def nothing_to_compare(row: Row, preset: str, settings: Mapping[str, Any]) -> str | None:
    """Why the row would equal the full model under these options; None where it differs."""
    config = make_config(preset, dict(settings))
    for key, number in row.needs.items():
        if _option(config, key) <= number:
            return f"{key}: is {number}, so the row {row.name} would equal the full model."
    return None


def combined(row: Row, preset: str, settings: Mapping[str, Any], seed: int) -> TrainConfig:
    """As `row_config`, without the checks."""
    return make_config(preset, merged(settings, row.options, {"seed": seed}))


def dotted(options: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested options by dotted name."""
    flat: dict[str, Any] = {}
    for key, value in options.items():
        flat |= dotted(value, f"{prefix}{key}.") if isinstance(value, Mapping) else {f"{prefix}{key}": value}
    return flat


def _option(config: TrainConfig, key: str) -> Any:
    value: Any = config
    for part in key.split("."):
        value = getattr(value, part)
    return value
