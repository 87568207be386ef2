"""Report: a run's numbers as strict JSON."""

from __future__ import annotations

import hashlib
import json
import math
import os
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from pydantic import BaseModel

from graings.errors import CheckpointError

METRICS_SCHEMA: Final = "graings.metrics/1"


def write_metrics(path: Path, document: Mapping[str, Any]) -> None:
    """Write strict JSON: never NaN or infinity (`ValueError` naming the key), never half a file."""
    wrong = next(_not_finite(document, ""), None)
    if wrong is not None:
        raise ValueError(f"{path.name}: {wrong} is not finite; say null and give a reason")
    write_text(path, json.dumps(document, indent=2, allow_nan=False) + "\n")


def read_metrics(path: Path) -> dict[str, Any]:
    """A document written by `write_metrics`. Raises `CheckpointError`, also for NaN and infinity."""
    try:
        document = json.loads(path.read_text(encoding="utf-8"), parse_constant=_refuse)
    except (OSError, ValueError) as error:
        raise CheckpointError(f"{path}: not readable ({error}). Finish the training run first.") from error
    if not isinstance(document, dict):
        raise CheckpointError(f"{path}: is not a JSON object. Finish the training run again.")
    return document


def write_text(path: Path, text: str) -> None:
    """Replace a file at once: a reader sees the old text or the new one, also after a power cut."""
    write_bytes(path, text.encode())


def write_bytes(path: Path, content: bytes) -> None:
    """As `write_text`, for what is not text."""
    handle, name = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.chmod(name, 0o644)  # mkstemp makes files for the owner alone
        os.replace(name, path)
    except BaseException:
        os.unlink(name)
        raise


def config_hash(config: BaseModel) -> str:
    """sha256 over the canonical JSON of a configuration."""
    canonical = json.dumps(config.model_dump(mode="json"), sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(canonical.encode()).hexdigest()


def _refuse(constant: str) -> float:
    raise ValueError(f"{constant} is not strict JSON")


def _not_finite(value: Any, where: str) -> Iterator[str]:
    """Keys of numbers that strict JSON cannot say."""
    if isinstance(value, float) and not math.isfinite(value):
        yield where
    elif isinstance(value, Mapping):
        for key, item in value.items():
            yield from _not_finite(item, f"{where}.{key}" if where else str(key))
    elif isinstance(value, Sequence) and not isinstance(value, str):
        for index, item in enumerate(value):
            yield from _not_finite(item, f"{where}[{index}]")
