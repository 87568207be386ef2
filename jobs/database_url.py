"""URLs of the job database: limits on waiting for a connection, and error messages without passwords."""

from __future__ import annotations

import logging
import re
from typing import Final
from urllib.parse import unquote

from sqlalchemy import make_url  # DBOS depends on SQLAlchemy

from jobs.job import JobError

LOG = logging.getLogger(__name__)

SQLITE_PREFIX: Final = "sqlite:///"

# How long to wait for a PostgreSQL server that does not answer: 5 s for a connection, 15 s for the acknowledgement of
# data sent, 25 s on an idle connection (10 s, then three probes 5 s apart). Parameters in the URL win over these.
CONNECTION_LIMITS: Final = {
    "connect_timeout": "5",
    "tcp_user_timeout": "15000",
    "keepalives": "1",
    "keepalives_idle": "10",
    "keepalives_interval": "5",
    "keepalives_count": "3",
}


def with_connection_limits(url: str) -> str:
    """The URL with `CONNECTION_LIMITS`; a SQLite URL stays as it is."""
    if url.startswith(SQLITE_PREFIX):
        return url
    parts = make_url(url)
    return parts.set(query={**CONNECTION_LIMITS, **parts.query}).render_as_string(hide_password=False)


def cannot_open(url: str, error: Exception) -> JobError:
    """The error for a database that cannot be opened, without the secrets of its URL."""
    if _is_unambiguous(url):
        return JobError(f"The job database{_redacted(url)} cannot be opened: {_reason(url, error)}")
    return JobError(
        f"The job database{_redacted(url)} cannot be opened: its URL is wrong or ambiguous. Write it like "
        "sqlite:///path or postgresql://user:password@host/database, and write @ / ? and % in a password as %40 %2F "
        "%3F and %25"
    )


def no_answer(url: str, error: Exception) -> JobError:
    """The error for a database that does not answer. The reason is only logged: clients need not see addresses."""
    LOG.warning("the job database%s does not answer: %s", _redacted(url), _reason(url, error))
    return JobError("The job database does not answer at the moment. Try again in a few seconds.")


# A PostgreSQL URL that every driver parses alike. In any other URL, one driver may take a part of the password for the
# host or the port, and quote it in its message.
_ESCAPE = "%[0-9A-Fa-f]{2}"
_UNAMBIGUOUS = re.compile(
    r"postgres(?:ql)?(?:\+\w+)?://"
    rf"(?:(?:[^:@/?%\s]|{_ESCAPE})*(?::(?P<password>(?:[^@/?%\s]|{_ESCAPE})*))?@)?"  # user, password
    rf"(?:(?:[\w.-]|{_ESCAPE})*|\[[0-9A-Fa-f:.]+\])(?::\d+)?"  # host, port
    r"(?:/[\w.-]*)?"  # database
    rf"(?:\?(?P<query>\w+=(?:[^@%\s]|{_ESCAPE})*))?"
)


def _is_unambiguous(url: str) -> bool:
    return url.startswith(SQLITE_PREFIX) or _UNAMBIGUOUS.fullmatch(url) is not None


def _redacted(url: str) -> str:
    """The part of a URL that holds no secret, with a space before it; empty if even the scheme is not clear."""
    if url.startswith(SQLITE_PREFIX):
        return f" {url}"
    scheme = re.match(r"[A-Za-z][A-Za-z0-9+.-]*://", url)
    return "" if scheme is None else f" {scheme[0]}…"


def _reason(url: str, error: Exception) -> str:
    """The first line of a driver's message, without the secrets of the URL."""
    if not _is_unambiguous(url):
        return type(error).__name__
    reason = (str(error).splitlines() or [repr(error)])[0]
    for secret in _secrets(url):
        reason = re.sub(rf"(?<!\w){re.escape(secret)}(?!\w)", "…", reason)
    return reason


def _secrets(url: str) -> set[str]:
    """The password and the password parameters of a URL, as written and decoded."""
    match = _UNAMBIGUOUS.fullmatch(url)
    if match is None:
        return set()
    pairs = [pair.partition("=") for pair in (match["query"] or "").split("&")]
    written = {match["password"] or "", *(value for key, _, value in pairs if "pass" in key)}
    return {form for secret in written for form in (secret, unquote(secret)) if form}
