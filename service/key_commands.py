"""The commands `keys create`, `keys list` and `keys revoke`."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path
from typing import Annotated, Literal, NoReturn

import typer
from rich.console import Console
from rich.table import Column, Table

from service.keys import Keys, Scope

app = typer.Typer(no_args_is_help=True, help="Make, list and revoke the keys of the service.")

Data = Annotated[Path, typer.Option(envvar="GRAINGS_DATA", help="The service's folder with captures and jobs.")]


@app.command()
def create(
    scope: Annotated[
        Literal["read", "train", "admin"],
        typer.Option(
            help="read: see and render the jobs of the key --of; train: make and change its own; admin: all jobs."
        ),
    ],
    name: Annotated[str, typer.Option(help="Whose key it is, for `keys list`.")],
    of: Annotated[
        str | None, typer.Option(help="For --scope read: the id of the key whose jobs it shows, from `keys list`.")
    ] = None,
    data: Data = Path("data"),
) -> None:
    """Make a key and show it. It cannot be shown again: only its hash is stored."""
    keys = Keys(data / "keys")
    if scope == "read" and of is None:
        _refuse("a key of scope read makes no jobs: name the key whose jobs it shows with --of ID.")
    if scope != "read" and of is not None:
        _refuse(f"--of is for --scope read; a key of scope {scope} has jobs of its own.")
    shown = None if of is None else keys.get(of)
    if of is not None and (shown is None or shown.kind != "key" or shown.scope is Scope.READ or not keys.usable(shown)):
        _refuse(f"{of!r} is no valid key of scope train or admin. `graings keys list` shows every id.")
    _, secret = keys.create(name, Scope(scope), parent=of)
    typer.echo(secret)


@app.command(name="list")
def list_keys(data: Data = Path("data")) -> None:
    """List the keys with their last use, and the links to jobs."""
    keys = Keys(data / "keys")
    whole = [Column(name, no_wrap=True) for name in ("id", "of", "state")]  # a narrow terminal breaks the others
    table = Table(whole[0], "kind", "name", "scope", whole[1], "made", "last used", whole[2], box=None)
    for key in keys.all():
        expired = key.revoked_at is None and not key.valid
        state = "valid" if keys.usable(key) else "expired" if expired else "revoked"
        dates = _date(key.created_at), _date(key.used_at)
        table.add_row(key.id, key.kind, key.name, key.scope, key.parent or "", *dates, state)
    Console().print(table)


@app.command()
def revoke(key_id: Annotated[str, typer.Argument(help="Id from `keys list`.")], data: Data = Path("data")) -> None:
    """Refuse a key from now on, with its sessions, its links and the keys that show its jobs."""
    keys = Keys(data / "keys")
    key = keys.get(key_id)
    if key is None:
        _refuse(f"there is no key {key_id!r} in {data}. `graings keys list` shows every id.")
    keys.revoke(key)


def _refuse(why: str) -> NoReturn:
    typer.echo(f"keys: {why}", err=True)
    raise typer.Exit(2)


def _date(seconds: float | None) -> str:
    return "never" if seconds is None else f"{datetime.fromtimestamp(seconds):%Y-%m-%d %H:%M}"
