"""Keys: who may use the service. A key is shown once, and only its SHA-256 is stored.

    <data>/keys/<id>.json   one key, session of a browser, or link to one job; ids begin with k, s or l
    <data>/keys/<id>.used   its modification time is when the key was last used

The secret has 256 random bits, so that a fast hash is enough. All processes that share the data folder share its keys,
and a revoked key is refused at the next request.
"""

from __future__ import annotations

import hashlib
import hmac
import re
import secrets
import time
from dataclasses import asdict, dataclass, replace
from enum import StrEnum
from json import loads
from pathlib import Path
from typing import Literal

from graings.storage.files import write_json

SESSION_S = 30 * 86_400.0
DISCARD_EVERY_S = 3_600.0
TOUCH_S = 60.0  # the time of the last use is exact to a minute, so that a request rarely writes

_ID = re.compile(r"[ksl][0-9a-f]{12}")
_SECRET = re.compile(rf"graings_({_ID.pattern})_([A-Za-z0-9_-]{{43}})")


class Scope(StrEnum):
    """What a key allows: to look at one job (only links), to read the jobs of another key, to make its own, all."""

    VIEW = "view"
    READ = "read"
    TRAIN = "train"
    ADMIN = "admin"

    def includes(self, other: Scope) -> bool:
        """Whether a key of this scope may do what needs `other`."""
        order = list(Scope)
        return order.index(self) >= order.index(other)


@dataclass(frozen=True, slots=True)
class Key:
    """A stored key. Times are Unix seconds.

    `parent` is what a session or link was made from, or the key whose jobs a key of scope `read` shows, and `job` the
    only job that a link shows. A revoked key stays in the list; sessions and links are removed.
    """

    id: str
    kind: Literal["key", "session", "link"]
    name: str
    scope: Scope
    digest: str
    created_at: float
    parent: str | None = None
    job: str | None = None
    expires_at: float | None = None
    revoked_at: float | None = None
    used_at: float | None = None

    @property
    def valid(self) -> bool:
        return self.revoked_at is None and (self.expires_at is None or time.time() < self.expires_at)

    @property
    def counted_as(self) -> str:
        """Whose limits its requests count for: all sessions of a key together, and a link apart from its key."""
        return self.parent if self.kind == "session" and self.parent else self.id


class Keys:
    """The keys in a folder. Any number of processes may use it."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._discard_at = 0.0  # time.monotonic()
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)

    def create(
        self,
        name: str,
        scope: Scope,
        kind: Literal["key", "session", "link"] = "key",
        *,
        parent: str | None = None,
        job: str | None = None,
    ) -> tuple[Key, str]:
        """A new key and its secret, which cannot be read again."""
        secret = secrets.token_urlsafe(32)
        expires_at = time.time() + SESSION_S if kind == "session" else None
        key_id = kind[0] + secrets.token_hex(6)
        key = Key(key_id, kind, name, scope, _digest(secret), time.time(), parent, job, expires_at)
        self._write(key)
        return key, f"graings_{key.id}_{secret}"

    def find(self, secret: str) -> Key | None:
        """The valid key with this secret, or None; remembers that it was used."""
        match = _SECRET.fullmatch(secret)
        key = self.get(match[1]) if match else None
        # Compared also when there is no such key: the time must not tell which ids exist.
        equal = hmac.compare_digest(_digest(match[2] if match else secret), key.digest if key else _digest(""))
        if key is None or not equal or not self.usable(key):
            return None
        if key.used_at is None or time.time() - key.used_at > TOUCH_S:
            self._file(key.id, "used").touch()
        return key

    def get(self, key_id: str) -> Key | None:
        """The key with this id, valid or not; None if there is none."""
        if not _ID.fullmatch(key_id):
            return None
        try:
            written = loads(self._file(key_id).read_bytes())
        except FileNotFoundError:
            return None
        used = self._file(key_id, "used")
        used_at = used.stat().st_mtime if used.exists() else None
        return Key(**{**written, "scope": Scope(written["scope"]), "used_at": used_at})

    def root(self, key: Key) -> str | None:
        """The id of the key to which the jobs belong that a key shows; None for what was made without a key."""
        if key.kind == "key" and key.parent is None:
            return key.id
        above = self.get(key.parent or "")
        return None if above is None else self.root(above)

    def all(self) -> list[Key]:
        """All keys, sessions and links, oldest first."""
        found = [self.get(path.stem) for path in self._folder.glob("*.json")]
        return sorted((key for key in found if key is not None), key=lambda key: key.created_at)

    def exist(self) -> bool:
        """Whether a key was ever made here, also if it is revoked."""
        return any(self._folder.glob("k*.json"))

    def revoke(self, key: Key) -> None:
        """Refuse the key, and all that was made from it, from now on."""
        if key.kind == "key":
            self._write(replace(key, revoked_at=time.time()))
        else:
            for suffix in ("json", "used"):
                self._file(key.id, suffix).unlink(missing_ok=True)

    def discard_expired(self) -> None:
        """Remove sessions and links that can no longer be used; at most once an hour, as it reads every key."""
        now = time.monotonic()
        if now < self._discard_at:
            return
        self._discard_at = now + DISCARD_EVERY_S
        for key in self.all():
            if key.kind != "key" and not self.usable(key):
                self.revoke(key)

    def usable(self, key: Key) -> bool:
        """Whether the key is valid, and all that it was made from."""
        if not key.valid:
            return False
        above = self.get(key.parent or "")
        return key.parent is None or (above is not None and self.usable(above))

    def _file(self, key_id: str, suffix: str = "json") -> Path:
        return self._folder / f"{key_id}.{suffix}"

    def _write(self, key: Key) -> None:
        write_json(self._file(key.id), asdict(key))


def _digest(secret: str) -> str:
    return hashlib.sha256(secret.encode("utf-8", "surrogateescape")).hexdigest()
