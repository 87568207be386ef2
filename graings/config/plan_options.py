"""PlanConfig: what the plan of a run may leave out."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from graings.config.sections import ConfigSection

# Parts that the plan may leave out although an option asks for them, and that a user may want to keep nevertheless.
Part = Literal["deformation", "residual", "alpha_loss", "growth"]


class PlanConfig(ConfigSection):
    """Which decisions of the plan are carried out. Read by `graings.plan` and `graings.training`."""

    mode: Literal["safe", "aggressive", "off"] = Field(
        "safe",
        description="safe: leave out what provably changes no picture by half a grey level; aggressive: also what only "
        "measurements suggest; off: nothing.",
    )
    keep: tuple[Part, ...] = Field(
        (), description="Parts that are never left out: deformation, residual, alpha_loss, growth."
    )
