"""The commands `keys create`, `keys list` and `keys revoke`."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path
from typing import Annotated, Literal

import typer
from rich.console import Console
from rich.table import Table

from service.keys import Keys, Scope

app = typer.Typer(no_args_is_help=True, help="Make, list and revoke the keys of the service.")

Data = Annotated[Path, typer.Option(envvar="GRAINGS_DATA", help="The service's folder with captures and jobs.")]


@app.command()
def create(
    scope: Annotated[
        Literal["read", "train", "admin"],
        typer.Option(help="read: see and render its own jobs; train: also change them; admin: the jobs of all."),
    ],
    name: Annotated[str, typer.Option(help="Whose key it is, for `keys list`.")],
    data: Data = Path("data"),
) -> None:
    """Make a key and show it. It cannot be shown again: only its hash is stored."""
    _, secret = Keys(data / "keys").create(name, Scope(scope))
    typer.echo(secret)


@app.command(name="list")
def list_keys(data: Data = Path("data")) -> None:
    """List the keys with their last use, and the links to jobs."""
    table = Table("id", "kind", "name", "scope", "made", "last used", "state", box=None)
    for key in Keys(data / "keys").all():
        state = "valid" if key.valid else "revoked" if key.revoked_at else "expired"
        table.add_row(key.id, key.kind, key.name, key.scope, _date(key.created_at), _date(key.used_at), state)
    Console().print(table)


@app.command()
def revoke(key_id: Annotated[str, typer.Argument(help="Id from `keys list`.")], data: Data = Path("data")) -> None:
    """Refuse a key, its sessions and its links from now on."""
    keys = Keys(data / "keys")
    key = keys.get(key_id)
    if key is None:
        typer.echo(f"keys: there is no key {key_id!r} in {data}. `graings keys list` shows every id.", err=True)
        raise typer.Exit(2)
    keys.revoke(key)


def _date(seconds: float | None) -> str:
    return "never" if seconds is None else f"{datetime.fromtimestamp(seconds):%Y-%m-%d %H:%M}"
