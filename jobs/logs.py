"""Logs of the service and its workers: lines for people, or one JSON object a line for machines."""

from __future__ import annotations

import logging
import os

from pythonjsonlogger.json import JsonFormatter


def log_to_stderr() -> None:
    """Log to standard error: JSON if the environment has GRAINGS_LOG=json, which also logs every request."""
    json = os.environ.get("GRAINGS_LOG") == "json"
    handler = logging.StreamHandler()
    lines, fields = "%(asctime)s %(name)s: %(message)s", "%(asctime)s %(levelname)s %(name)s %(message)s"
    handler.setFormatter(JsonFormatter(fields) if json else logging.Formatter(lines))
    logging.basicConfig(level=logging.INFO, handlers=[handler])
    logging.getLogger("service.requests").setLevel(logging.INFO if json else logging.WARNING)
