"""Lease: is that worker alive?

The answer comes from the kernel (`flock`, one machine) or from PostgreSQL (a session's advisory lock, many
machines): both let go by themselves when the holder dies, so no clock and no heartbeat is involved. Knows nothing of
jobs but how it is said that their database is away.
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

import psycopg  # DBOS depends on it, so it is always there
from psycopg.conninfo import conninfo_to_dict, make_conninfo

from jobs.engine import PATIENCE, cannot_open, no_answer

LOG = logging.getLogger(__name__)

_NAMESPACE = 0x67726169  # "grai": first key of our advisory locks, apart from everybody else's
# How long to wait for those who ask at the same time: somewhat longer than one of them waits for a connection.
_TURN_S = 10.0


class Leases(Protocol):
    """Named locks that die with their holder. Methods raise `JobError` while whoever keeps the locks is away."""

    def take(self, name: str) -> bool:
        """Take the lease for ourselves; False when somebody else holds it."""

    def keep(self, name: str) -> bool:
        """Make sure that we still hold a lease we took, taking it again where it was lost; False if we cannot."""

    def take_from_the_dead(self, name: str) -> bool:
        """Take another holder's lease; False when that holder lives. `release` it after clearing up."""

    def release(self, name: str) -> None:
        """Let a lease go for good: its name is not used again."""

    def alive(self) -> int:
        """How many leases are held at the moment, by anybody."""

    def close(self) -> None:
        """Let everything go."""


class FileLeases:
    """Leases on one machine: a locked file each. A file that is gone is a holder that left."""

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

    def take(self, name: str) -> bool:
        handle = self._lock(name, os.O_CREAT)
        if handle is None:
            return False
        self._held[name] = handle
        return True

    def keep(self, name: str) -> bool:
        return name in self._held

    def take_from_the_dead(self, name: str) -> bool:
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
                # Shared, so that two who look at the same time do not take each other for a holder.
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

    A session that ended, as all do when the server starts again, is followed by another one that holds nothing until
    `keep` takes it again. Safe to use from several threads.
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
        return psycopg.connect(make_conninfo("", **{**PATIENCE, **conninfo_to_dict(self._url)}), autocommit=True)

    @staticmethod
    def _key(name: str) -> int:
        return int.from_bytes(hashlib.sha256(name.encode()).digest()[:4], "big", signed=True)

    def _ask(self, query: str, *values: int) -> object:
        """The one value that a query gives, from a new session where the old one was lost. Raises `JobError`."""
        try:
            with self._turn():
                try:
                    return self._value(query, *values)
                except psycopg.OperationalError:
                    self._reconnect()
                    LOG.warning("the session that holds leases was lost; another one takes its place")
                    return self._value(query, *values)
        except (psycopg.OperationalError, TimeoutError) as error:
            raise no_answer(self._url, error) from error

    @contextmanager
    def _turn(self) -> Iterator[None]:
        # With a limit: where no connection is to be had, those who wait would otherwise wait for each other in turn.
        if not self._guard.acquire(timeout=_TURN_S):
            raise TimeoutError("others wait for it already")
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

    def take(self, name: str) -> bool:
        taken = self._ask("select pg_try_advisory_lock(%s, %s)", _NAMESPACE, self._key(name)) is True
        if taken:
            self._held.add(name)
        return taken

    def keep(self, name: str) -> bool:
        self._ask("select 1")  # a lost session has lost its locks, which nobody says unless asked
        return name in self._held or self.take(name)

    def take_from_the_dead(self, name: str) -> bool:
        return self.take(name)

    def release(self, name: str) -> None:
        if name in self._held:
            self._held.discard(name)
            self._ask("select pg_advisory_unlock(%s, %s)", _NAMESPACE, self._key(name))

    def alive(self) -> int:
        # The view shows the locks of all databases of the server.
        count = self._ask(
            "select count(*) from pg_locks where locktype = 'advisory' and classid = %s and granted"
            " and database = (select oid from pg_database where datname = current_database())",
            _NAMESPACE,
        )
        return int(str(count))

    def close(self) -> None:
        self._connection.close()


def open_leases(database_url: str, folder: Path) -> Leases:
    """Leases that reach as far as the database does."""
    return FileLeases(folder) if database_url.startswith("sqlite") else PostgresLeases(database_url)
