"""JSON documents of a capture: parsed and validated by a pydantic type, with failures as `CaptureError`."""

from __future__ import annotations

import json
from typing import TypeVar

from pydantic import TypeAdapter, ValidationError

from graings.errors import CaptureError

T = TypeVar("T")


def parse_json(kind: TypeAdapter[T], data: bytes, file: str) -> T:
    """`data` as `kind`. Raises `CaptureError` with the first invalid field."""
    try:
        return kind.validate_json(data.decode(json.detect_encoding(data)))  # UTF-8, 16 or 32, with a mark or without
    except UnicodeDecodeError as error:
        raise CaptureError(
            f"is not text ({error.reason})", file=file, remedy="Save it as UTF-8, or export the capture again."
        ) from error
    except ValidationError as error:
        problems = error.errors(include_url=False, include_input=False, include_context=False)
        first = problems[0]
        field = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in first["loc"]).lstrip(".")
        problem = "the key is missing" if first["type"] == "missing" else first["msg"][0].lower() + first["msg"][1:]
        if len(problems) > 1:
            problem += f" (and {len(problems) - 1} more)"
        raise CaptureError(
            problem, file=file, field=field or None, remedy="Correct it or export the capture again."
        ) from error
