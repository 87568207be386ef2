"""Leases: which workers are alive.

A worker holds a lease as long as it lives: a locked file (`flock`, on one machine) or an advisory lock of a PostgreSQL
session (on many machines). The kernel or the server releases it when the worker dies, without clocks or heartbeats;
the server finds out within half a minute that a machine is gone.
"""

from __future__ import annotations

import fcntl
import hashlib
import logging
import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Protocol

import psycopg  # DBOS depends on it
from psycopg.conninfo import conninfo_to_dict, make_conninfo

from jobs.database_url import CONNECTION_LIMITS, cannot_open, no_answer

LOG = logging.getLogger(__name__)

_NAMESPACE = 0x67726169  # "grai": first key of our advisory locks, which separates them from those of other programs
# How long a thread waits for the session, in seconds: longer than another thread needs to open a connection.
_SESSION_WAIT_S = 10.0


class Leases(Protocol):
    """Named locks, released when their holder dies. Methods raise `JobError` if the database does not answer."""

    def acquire(self, name: str) -> bool:
        """Take the lease; False if another process holds it."""

    def renew(self, name: str) -> bool:
        """Whether we still hold a lease that we acquired; acquires it again if our session was closed meanwhile."""

    def acquire_from_dead(self, name: str) -> bool:
        """Take the lease of another worker; False if that worker is alive. Call `release` after cleaning up."""

    def release(self, name: str) -> None:
        """Release a lease for good: its name is not used again."""

    def alive(self) -> int:
        """How many leases are held now, by any process."""

    def close(self) -> None:
        """Release everything."""


class FileLeases:
    """Leases on one machine: one locked file each. A missing file means that the holder has ended."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        folder.mkdir(parents=True, exist_ok=True)
        self._held: dict[str, int] = {}

    def _file(self, name: str) -> Path:
        return self._folder / f"{name}.lock"

    def _lock(self, name: str, flags: int) -> int | None:
        handle = os.open(self._file(name), flags | os.O_RDWR | os.O_CLOEXEC, 0o644)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(handle)
            return None
        return handle

    def acquire(self, name: str) -> bool:
        handle = self._lock(name, os.O_CREAT)
        if handle is None:
            return False
        self._held[name] = handle
        return True

    def renew(self, name: str) -> bool:
        return name in self._held

    def acquire_from_dead(self, name: str) -> bool:
        try:
            handle = self._lock(name, 0)
        except FileNotFoundError:
            return True
        if handle is None:
            return False
        self._held[name] = handle
        return True

    def release(self, name: str) -> None:
        handle = self._held.pop(name, None)
        if handle is not None:
            self._file(name).unlink(missing_ok=True)
            os.close(handle)

    def alive(self) -> int:
        held = 0
        for file in self._folder.glob("*.lock"):
            if file.stem in self._held:
                held += 1
                continue
            try:
                handle = os.open(file, os.O_RDONLY | os.O_CLOEXEC)
            except FileNotFoundError:
                continue
            try:
                # Shared, so that two processes that count at the same time do not count each other.
                fcntl.flock(handle, fcntl.LOCK_SH | fcntl.LOCK_NB)
            except BlockingIOError:
                held += 1
            finally:
                os.close(handle)
        return held

    def close(self) -> None:
        for name in list(self._held):
            self.release(name)


class PostgresLeases:
    """Leases on many machines: advisory locks of one PostgreSQL session, released by the server when it ends.

    When the server closes the session, as in a restart, a new one is opened, without locks until `renew`. Thread-safe.
    """

    def __init__(self, url: str) -> None:
        self._url = url
        self._guard = threading.Lock()
        self._held: set[str] = set()
        try:
            self._connection = self._connect()
        except psycopg.Error as error:
            raise cannot_open(url, error) from error

    def _connect(self) -> psycopg.Connection[tuple[object, ...]]:
        parameters = {**CONNECTION_LIMITS, **conninfo_to_dict(self._url)}
        connection = psycopg.connect(make_conninfo("", **parameters), autocommit=True)
        # Its default is two hours: for so long the jobs of a machine that is gone would wait.
        connection.execute(
            "set tcp_keepalives_idle = 10; set tcp_keepalives_interval = 5; set tcp_keepalives_count = 3;"
            "set tcp_user_timeout = 15000"
        )
        return connection

    @staticmethod
    def _key(name: str) -> int:
        return int.from_bytes(hashlib.sha256(name.encode()).digest()[:4], "big", signed=True)

    def _query(self, query: str, *values: int) -> object:
        """The single value of a query, in a new session if the old one was closed. Raises `JobError`."""
        try:
            with self._session():
                try:
                    return self._value(query, *values)
                except psycopg.OperationalError:
                    self._reconnect()
                    LOG.warning("the database session that holds the leases was closed; opened a new one")
                    return self._value(query, *values)
        except (psycopg.OperationalError, TimeoutError) as error:
            raise no_answer(self._url, error) from error

    @contextmanager
    def _session(self) -> Iterator[None]:
        # With a limit: otherwise, when the database does not answer, each of many threads waits for all before it.
        if not self._guard.acquire(timeout=_SESSION_WAIT_S):
            raise TimeoutError("other threads wait for it already")
        try:
            yield
        finally:
            self._guard.release()

    def _value(self, query: str, *values: int) -> object:
        row = self._connection.execute(query.encode(), values).fetchone()
        return row[0] if row else None

    def _reconnect(self) -> None:
        self._connection.close()
        self._held.clear()
        self._connection = self._connect()

    def acquire(self, name: str) -> bool:
        acquired = self._query("select pg_try_advisory_lock(%s, %s)", _NAMESPACE, self._key(name)) is True
        if acquired:
            self._held.add(name)
        return acquired

    def renew(self, name: str) -> bool:
        self._query("select 1")  # notices a closed session, which no longer holds its locks
        return name in self._held or self.acquire(name)

    def acquire_from_dead(self, name: str) -> bool:
        return self.acquire(name)

    def release(self, name: str) -> None:
        if name in self._held:
            self._held.discard(name)
            self._query("select pg_advisory_unlock(%s, %s)", _NAMESPACE, self._key(name))

    def alive(self) -> int:
        # The view has the locks of all databases of the server.
        count = self._query(
            "select count(*) from pg_locks where locktype = 'advisory' and classid = %s and granted"
            " and database = (select oid from pg_database where datname = current_database())",
            _NAMESPACE,
        )
        return int(str(count))

    def close(self) -> None:
        self._connection.close()


def open_leases(database_url: str, folder: Path) -> Leases:
    """Leases for all processes that share the database: files in `folder` for SQLite, else in PostgreSQL."""
    return FileLeases(folder) if database_url.startswith("sqlite") else PostgresLeases(database_url)
