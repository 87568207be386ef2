"""Document: base of everything that is written as JSON and read back: frozen, no unknown field, no NaN or infinity."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError

from graings.errors import CheckpointError


class Document(BaseModel):
    """One JSON object whose fields, units and bounds are part of its type and of the published JSON Schema."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, allow_inf_nan=False, json_schema_serialization_defaults_required=True
    )

    def to_json(self) -> dict[str, Any]:
        """The values as they stand in the file."""
        return self.model_dump(mode="json", by_alias=True)


AnyDocument = TypeVar("AnyDocument", bound=Document)


def read_document(path: Path, kind: type[AnyDocument], remedy: str) -> AnyDocument:
    """The document in the file `path`.

    Raises `CheckpointError` naming the file, the first field that does not fit, and `remedy`.
    """
    try:
        # pydantic's own JSON parser accepts NaN and Infinity, which strict JSON does not have.
        return kind.model_validate(json.loads(path.read_text(encoding="utf-8"), parse_constant=_refuse))
    except ValidationError as error:
        raise CheckpointError(f"{path}: {first_problem(error)}. {remedy}") from error
    except (OSError, ValueError, RecursionError) as error:
        raise CheckpointError(f"{path}: not readable ({error}). {remedy}") from error


def first_problem(error: ValidationError) -> str:
    """The first field that does not fit and why, and how many more there are."""
    first, *others = error.errors(include_url=False, include_context=False, include_input=False)
    field = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in first["loc"]).lstrip(".")
    more = f" ({len(others)} more fields do not fit)" if others else ""
    return f"{field or 'the document'}: {first['msg']}{more}"


def _refuse(constant: str) -> float:
    raise ValueError(f"{constant} is not strict JSON")
