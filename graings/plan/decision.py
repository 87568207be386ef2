"""Decision: one part of the model, the loss or the initialisation, what becomes of it, and the evidence."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, JsonValue

from graings.document import Document

Component = Literal[
    "deformation",
    "residual",
    "temporal_loss",
    "rigidity",
    "alpha_loss",
    "random_points",
    "carving",
    "undistortion",
    "view_dependence",
    "growth",
    "preset",
]
Verdict = Literal["keep", "drop", "propose", "later"]
Kind = Literal["exact", "representable", "bounded", "estimated", "user"]
Operator = Literal["==", "<=", "<", ">=", ">"]
Seconds = Annotated[float, Field(ge=0)]


class Condition(Document):
    """The measurement that a decision rests on: the part is not needed where `value op threshold` holds."""

    name: str = Field(description="What was measured, in plain words.")
    op: Operator = Field(description="Comparison of the value with the threshold.")
    value: float | None = Field(description="The measured value; null where the capture does not show it.")
    threshold: float = Field(description="The value that it is compared with.")
    unit: str = Field("", description="Unit of value and threshold; empty for a count or ratio.")

    @property
    def holds(self) -> bool:
        """Whether the part is not needed; false where nothing was measured."""
        if self.value is None:
            return False
        value, threshold = self.value, self.threshold
        results: dict[Operator, bool] = {
            "==": value == threshold,
            "<=": value <= threshold,
            "<": value < threshold,
            ">=": value >= threshold,
            ">": value > threshold,
        }
        return results[self.op]

    def __str__(self) -> str:
        unit = f" {self.unit}" if self.unit else ""
        if self.value is None:
            return f"{self.name} not measurable"
        signs: dict[Operator, str] = {"==": "=", "<=": "≤", "<": "<", ">=": "≥", ">": ">"}
        opposites: dict[Operator, str] = {"==": "≠", "<=": ">", "<": "≥", ">=": "<", ">": "≤"}
        sign = (signs if self.holds else opposites)[self.op]
        return f"{self.name} {self.value:.4g} {sign} {self.threshold:.4g}{unit}"


class Bound(Document):
    """By how much leaving the part out may change a picture."""

    value: float = Field(ge=0, description="Greatest change of a pixel's channel, values in [0, 1].")
    how: str = Field(description="Why it is no more, in plain words.")


class Saving(Document):
    """CPU seconds of the whole training that leaving the part out saves."""

    predicted_s: Seconds | None = Field(description="Predicted from the calibration; null without one.")
    predicted_share: float | None = Field(
        ge=0, le=1, description="The same as a share of the training with the part; null without a calibration."
    )
    measured_s: float | None = Field(
        None, description="Measured in this training as steps before and after; null where there are no such steps."
    )


class Decision(Document):
    """One component and what becomes of it."""

    component: Component = Field(description="Part of the model, the loss or the initialisation.")
    decision: Verdict = Field(
        description="keep: it is used; drop: it is left out; propose: it is used, and what was measured suggests to "
        "leave it out; later: training measures whether it is needed and may leave it out."
    )
    kind: Kind = Field(
        description="Why dropping it is safe. exact: it would compute the same; representable: the other components "
        "can represent its effect; bounded: pixels change by no more than `bound`; estimated: measured, may be wrong; "
        "user: an option asks for it."
    )
    reason: str = Field(description="The reason in plain words.")
    condition: Condition | None = Field(None, description="The measurement; null where there is none.")
    bound: Bound | None = Field(None, description="Change of a picture; null where it is not bounded.")
    saving: Saving | None = Field(None, description="What leaving it out saves; null where that is not known.")
    iteration: int | None = Field(
        None, ge=0, description="Iteration at which training decided, or may decide first; null before training."
    )
    override: dict[str, JsonValue] | None = Field(
        None, description="Options, by dotted name, that decide otherwise; null where there are none."
    )
