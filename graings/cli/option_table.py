"""The command that lists the options of a configuration."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Annotated, get_args

import typer
from annotated_types import Ge, Gt, Le, Lt  # pydantic depends on it
from rich.console import Console
from rich.table import Table
from rich.text import Text

from graings.config import ConfigSection, make_config, options


def show_options(
    preset: Annotated[
        str, typer.Option(help="Show the values of this preset; a star marks those that are not the default.")
    ] = "standard",
    as_json: Annotated[bool, typer.Option("--json", help="JSON schema and presets instead of a table.")] = False,
) -> None:
    """List every option of --set."""
    console = Console()
    if as_json:
        console.print_json(json.dumps(options()))
        return
    table = Table("option", "value", "bounds", "", box=None, pad_edge=False, header_style="bold")
    defaults = {name: value for name, value, *_ in _fields(make_config())}
    for name, value, bounds, text in _fields(make_config(preset)):
        shown = Text(value, style="cyan") if value == defaults[name] else Text(f"{value} *", style="bold cyan")
        table.add_row(Text(name), shown, Text(bounds, style="dim"), Text(text))
    console.print(table)


def _fields(part: ConfigSection, prefix: str = "") -> Iterator[tuple[str, str, str, str]]:
    """Name, value, bounds and help of every option below `part`."""
    for name, field in type(part).model_fields.items():
        value = getattr(part, name)
        if isinstance(value, ConfigSection):
            yield from _fields(value, f"{prefix}{name}.")
            continue
        # Bounds of the value itself, or of each item of a list.
        items = [info for item in get_args(field.annotation)[:1] for info in getattr(item, "__metadata__", ())]
        metadata = [*field.metadata, *(constraint for info in items for constraint in info.metadata)]
        bounds = [text for constraint in metadata if (text := _bound(constraint))]
        yield f"{prefix}{name}", json.dumps(value), ", ".join(bounds), field.description or ""


def _bound(constraint: object) -> str:
    match constraint:
        case Ge(ge=limit):
            return f"≥ {limit}"
        case Gt(gt=limit):
            return f"> {limit}"
        case Le(le=limit):
            return f"≤ {limit}"
        case Lt(lt=limit):
            return f"< {limit}"
    return ""
