"""The published interface in short, for its snapshot: `python -m tests.service.contract` writes it again."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from service import problems, schemas
from service.app import create_app
from service.routes import sessions
from service.settings import Settings

SNAPSHOT = Path(__file__).with_name("openapi.txt")


def summary(document: dict[str, Any]) -> str:
    """One line for each operation with its parameters and answers, and one for each schema of ours with its fields."""
    lines = []
    for path, operations in sorted(document["paths"].items()):
        for method, operation in sorted(operations.items()):
            parameters = [
                f"{parameter['in']}:{parameter['name']}{'*' * parameter.get('required', False)}"
                for parameter in operation.get("parameters", [])
                if parameter["in"] != "cookie"
            ]
            bodies = [f"body:{kind}" for kind in operation.get("requestBody", {}).get("content", {})]
            answers = [f"{status}:{_answer(answer)}" for status, answer in sorted(operation["responses"].items())]
            name = f"{method.upper()} {path} {operation['operationId']}"
            lines.append(" ".join([name, *sorted(parameters), *bodies, "->", *answers]))
    ours = {name for module in (problems, schemas, sessions) for name in vars(module)}
    for name, schema in sorted(document["components"]["schemas"].items()):
        if name not in ours:
            continue  # a document with a schema of its own, see docs/schemas
        required = schema.get("required", [])
        fields = [f"{field}{'*' * (field in required)}" for field in sorted(schema.get("properties", {}))]
        lines.append(" ".join([name, *(fields or [f"enum:{value}" for value in schema.get("enum", [])])]))
    return "\n".join(lines) + "\n"


def _answer(answer: dict[str, Any]) -> str:
    names = [
        content.get("schema", {}).get("$ref", kind).rpartition("/")[2]
        for kind, content in answer.get("content", {}).items()
    ]
    return "|".join(names) or "-"


if __name__ == "__main__":
    SNAPSHOT.write_text(summary(create_app(Settings()).openapi()))
