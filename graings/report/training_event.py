"""TrainingEvent: what the events of a training run share.

An event is its iteration, its kind and numbers. The message for people is derived from them, and travels with the
event wherever it is written. Programs decide by `kind`.
"""

from __future__ import annotations

from abc import abstractmethod
from typing import Any, Final, Self

from pydantic import Field, computed_field, model_validator

from graings.document import Document

KIND: Final = "Kind of the event."


class TrainingEvent(Document):
    """What all events share."""

    iteration: int = Field(ge=0, description="Iteration of the run in which it happened; 0 before the first step.")

    @computed_field(description="The event in plain words, derived from its numbers.")  # type: ignore[prop-decorator]
    @property
    def message(self) -> str:
        """The event in plain words."""
        return self._words()

    @abstractmethod
    def _words(self) -> str:
        """The sentence of `message`."""

    @model_validator(mode="before")
    @classmethod
    def _without_message(cls, values: Any) -> Any:
        """The message is written, but not read: it follows from the other fields."""
        return {key: values[key] for key in values if key != "message"} if isinstance(values, dict) else values

    def at(self, iteration: int) -> Self:
        """The same event at another iteration."""
        return self.model_copy(update={"iteration": iteration})
