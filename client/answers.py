"""What the service answers: jobs, events of their training, and errors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

ENDED = ("succeeded", "failed", "cancelled", "diverged")


@dataclass(frozen=True, slots=True)
class RemoteJob:
    """A training job. `document` is the whole answer of the service, which docs/api.md describes.

    `progress` is the trainer's last report, `checkpoint` the iteration of the newest model, None before the first.
    """

    id: str
    name: str
    state: str
    error: str | None
    checkpoint: int | None
    progress: dict[str, Any] | None
    document: dict[str, Any]

    @classmethod
    def of(cls, document: dict[str, Any]) -> RemoteJob:
        """The job in an answer."""
        fields = ("id", "name", "state", "error", "checkpoint", "progress")
        return cls(**{name: document[name] for name in fields}, document=document)

    @property
    def ended(self) -> bool:
        """Whether it stays in this state until somebody changes it."""
        return self.state in ENDED


@dataclass(frozen=True, slots=True)
class Event:
    """One event of a job: `progress` with a report as `data`, or `state` and at last `end` with the job."""

    kind: str
    data: dict[str, Any]


class ClientError(Exception):
    """Base class of the errors of this package; the messages are for people."""


class RefusedError(ClientError):
    """The service refused a request. `problem` is its document (RFC 9457), `type` in it names the kind of error."""

    def __init__(self, status: int, problem: dict[str, Any]) -> None:
        super().__init__(problem.get("detail") or problem.get("title") or f"The service answered {status}.")
        self.status = status
        self.problem = problem
