"""A PostgreSQL server of its own for tests and measurements, which can be stopped and started again."""

from __future__ import annotations

import os
import pwd
import shutil
import signal
import socket
import subprocess
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

START_S = 120.0


def is_installed() -> bool:
    """Whether the programs of the server are there."""
    return shutil.which("initdb") is not None and shutil.which("postgres") is not None


def _user() -> str:
    """The user that runs the server, which must not be root."""
    return "postgres" if os.geteuid() == 0 else pwd.getpwuid(os.geteuid()).pw_name


class Server:
    """A server on `host`, whose processes are started behind the command `prefix`; its files are in `folder`."""

    def __init__(self, host: str = "127.0.0.1", prefix: Sequence[str] = (), folder: Path | None = None) -> None:
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self.port = probe.getsockname()[1]
        self.url = f"postgresql://grain@{host}:{self.port}/postgres"
        self._host, self._prefix, self._user = host, prefix, _user()
        # The folders of tests are closed to other users, so the server's lies beside them.
        self._data = Path(tempfile.mkdtemp(prefix="grain-postgres-", dir=folder))
        shutil.chown(self._data, self._user)
        command = ["initdb", "-D", self._data, "-U", "grain", "-A", "trust", "-N"]
        subprocess.run(command, user=self._user, cwd=self._data, check=True, stdout=subprocess.DEVNULL)
        with (self._data / "pg_hba.conf").open("a") as rules:
            rules.write("host all all samenet trust\n")
        self.start()

    def start(self) -> None:
        settings = ["-c", f"unix_socket_directories={self._data}", "-c", "fsync=off", "-h", self._host]
        command = ["postgres", "-D", str(self._data), "-p", str(self.port), *settings]
        # A prefix may need root, so that the user changes behind it.
        change = ["setpriv", f"--reuid={self._user}", "--clear-groups"] if self._prefix else []
        user = None if self._prefix else self._user
        with (self._data / "server.log").open("ab") as log:
            self._process = subprocess.Popen(
                [*self._prefix, *change, *command], user=user, cwd=self._data, stdout=log, stderr=log
            )
        ready = ["pg_isready", "-h", self._host, "-p", str(self.port), "-q"]
        deadline = time.monotonic() + START_S
        while subprocess.run(ready, check=False).returncode != 0:
            if time.monotonic() > deadline:
                raise RuntimeError(f"PostgreSQL did not start: {(self._data / 'server.log').read_text()[-2000:]}")
            time.sleep(0.1)

    def stop(self, number: signal.Signals = signal.SIGINT) -> None:
        """End the server: SIGINT closes all sessions first, SIGQUIT crashes it."""
        self._process.send_signal(number)
        self._process.wait()

    def start_if_ended(self) -> None:
        """Start a server that ended by itself, as on a full disk."""
        if self._process.poll() is not None:
            self.start()

    def remove(self) -> None:
        self.stop()
        shutil.rmtree(self._data)

    @contextmanager
    def stopped(self) -> Iterator[None]:
        self.stop()
        try:
            yield
        finally:
            self.start()


@contextmanager
def running(host: str = "127.0.0.1", prefix: Sequence[str] = (), folder: Path | None = None) -> Iterator[Server]:
    """A server for as long as the context lasts."""
    server = Server(host, prefix, folder)
    try:
        yield server
    finally:
        server.remove()
