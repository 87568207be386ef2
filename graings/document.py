"""Document: base of everything that is written as JSON and read back: frozen, no unknown field, no NaN or infinity."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError

from graings.errors import CheckpointError


class Document(BaseModel):
    """One JSON object whose fields, units and bounds are part of its type, and of the published JSON Schema."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, allow_inf_nan=False, json_schema_serialization_defaults_required=True
    )


AnyDocument = TypeVar("AnyDocument", bound=Document)


def read_document(path: Path, kind: type[AnyDocument], remedy: str) -> AnyDocument:
    """The document of this kind in the file `path`.

    Raises `CheckpointError` naming the file, the first field that does not fit and `remedy`.
    """
    try:
        # Not the parser of pydantic, which accepts NaN and Infinity.
        return kind.model_validate(json.loads(path.read_text(encoding="utf-8"), parse_constant=_refuse))
    except ValidationError as error:
        raise CheckpointError(f"{path}: {problem(error)}. {remedy}") from error
    except (OSError, ValueError, RecursionError) as error:
        raise CheckpointError(f"{path}: not readable ({error}). {remedy}") from error


def problem(error: ValidationError) -> str:
    """The first field that does not fit, why, and how many more there are."""
    first, *others = error.errors(include_url=False)
    field = ".".join(str(part) for part in first["loc"]) or "the document"
    more = f" (and {len(others)} more)" if others else ""
    return f"{field}: {first['msg']}{more}"


def _refuse(constant: str) -> float:
    raise ValueError(f"{constant} is not strict JSON")
