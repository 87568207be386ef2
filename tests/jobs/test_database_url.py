"""Errors about a database never show the password in its URL."""

from __future__ import annotations

from pathlib import Path

import pytest
from sqlalchemy import make_url

from jobs.database_url import CONNECTION_LIMITS, cannot_open, no_answer, with_connection_limits
from jobs.engine import Engine
from jobs.job import JobError


def test_a_database_that_cannot_be_opened_is_named_without_its_password(tmp_path: Path) -> None:
    with pytest.raises(JobError, match="nowhere"):
        Engine(f"sqlite:///{tmp_path}/nowhere/jobs.sqlite")
    with pytest.raises(JobError) as caught:
        Engine("postgresql://me:secret@127.0.0.1:1/none?connect_timeout=1")
    assert "secret" not in str(caught.value)


@pytest.mark.parametrize(
    "url",
    [
        "postgresql://127.0.0.1:1/none?user=me&password=geheim",
        "postgresql://127.0.0.1:1/none?geheim",
        "postgresql//me:geheim@h",
        "postgresql://me:ge@heim@127.0.0.1:1/none",  # taken for a part of the host
        "postgresql://me:ge/heim@127.0.0.1:1/none",
        "postgresql://me:geheim",  # taken for the port
        "mysql://me:geheim@127.0.0.1:1/none",
        "sqlite://me:geheim@h",
        "geheim",
    ],
)
def test_no_part_of_a_password_is_shown_however_the_url_is_written(url: str) -> None:
    with pytest.raises(JobError, match="cannot be opened") as caught:
        Engine(url)
    assert "heim" not in str(caught.value)


def test_the_message_of_a_driver_is_shown_without_the_password(caplog: pytest.LogCaptureFixture) -> None:
    error = OSError('password authentication failed for user "me" with ge%heim, ge%25heim\nLINE 1')
    message = str(cannot_open("postgresql://me:ge%25heim@h/none", error))
    assert message.endswith('cannot be opened: password authentication failed for user "me" with …, …')
    assert "h/none" not in message
    message = str(no_answer("postgresql://me@h/none?sslpassword=geheim", OSError("geheim at h is down")))
    assert "down" not in message  # which the service sends to clients
    assert "… at h is down" in caplog.text


def test_waiting_for_a_database_is_limited_unless_its_url_sets_other_limits() -> None:
    url = make_url(with_connection_limits("postgresql://me:a%40b@h/none?connect_timeout=9&options=-c%20x%3D1"))
    assert (url.password, url.query["options"]) == ("a@b", "-c x=1")
    assert url.query == {**CONNECTION_LIMITS, "connect_timeout": "9", "options": "-c x=1"}
