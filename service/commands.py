"""The command `serve`; also `python -m service.commands`."""

from __future__ import annotations

import signal
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated, Any

import typer
import uvicorn

from graings.errors import ConfigError
from jobs.engine import Engine
from jobs.job import JobError
from jobs.logs import log_to_stderr
from jobs.parent import watch_parent
from jobs.store import Store
from service.app import create_app
from service.keys import Keys
from service.settings import Settings
from service.worker_child import WorkerChild

GRACEFUL_S = 10  # for open requests, such as an image that is being rendered


def serve(
    data: Annotated[Path | None, typer.Option(help="Folder with captures and jobs (GRAINGS_DATA, ./data).")] = None,
    database: Annotated[
        str | None, typer.Option(help="sqlite:///… or postgresql://… (GRAINGS_DATABASE; SQLite in the data folder).")
    ] = None,
    host: Annotated[str | None, typer.Option(help="Address to listen on (GRAINGS_HOST, 127.0.0.1).")] = None,
    port: Annotated[int | None, typer.Option(help="Port to listen on (GRAINGS_PORT, 8000).")] = None,
    with_worker: Annotated[bool, typer.Option("--with-worker", help="Start a worker beside the service.")] = False,
    threads: Annotated[
        int | None, typer.Option(min=1, max=256, help="CPU threads of that worker's job (all cores).")
    ] = None,
    exit_with_parent: Annotated[
        bool, typer.Option("--exit-with-parent", help="Stop when standard input ends.")
    ] = False,
) -> None:
    """Serve the REST interface and its page until interrupted."""
    log_to_stderr()
    try:
        settings = Settings.from_environment(data=data, database=database, host=host, port=port)
    except ConfigError as error:
        typer.echo(f"serve: {error}", err=True)
        raise typer.Exit(2) from error
    try:
        # Opened once before the server starts, which would report an error as a traceback.
        Store(settings.data)
        Engine(settings.database_url).close()
    except (OSError, JobError) as error:
        typer.echo(f"serve: {error}. Choose another --data or --database.", err=True)
        raise typer.Exit(1) from error
    if not settings.is_local and not any(key.valid for key in Keys(settings.data / "keys").all()):
        typer.echo(
            f"serve: other machines can reach {settings.host}, and there is no key. Make one first: "
            f"graings keys create --scope admin --name NAME --data {settings.data}",
            err=True,
        )
        raise typer.Exit(2)
    app = create_app(settings)
    logs: dict[str, Any] = {"log_config": None, "access_log": False}
    config = uvicorn.Config(app, settings.host, settings.port, timeout_graceful_shutdown=GRACEFUL_S, **logs)
    server = uvicorn.Server(config)
    app.state.stopping = lambda: server.should_exit  # event streams end; their clients come back to the next process

    def stop() -> None:
        server.should_exit = True

    # uvicorn handles signals and raises them again after it has ended; that must not interrupt the end of the worker.
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stop())
    if exit_with_parent:
        watch_parent(stop)
    with ExitStack() as stack:
        if with_worker:
            stack.enter_context(WorkerChild(settings, threads))
        server.run()
    if not server.started:
        raise typer.Exit(1)


if __name__ == "__main__":
    typer.run(serve)
