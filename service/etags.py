"""Entity tags: whether a client has what would be sent."""

from __future__ import annotations


def matches(if_none_match: str | None, etag: str) -> bool:
    """Whether the header If-None-Match names `etag`."""
    known = [tag.strip().removeprefix("W/") for tag in (if_none_match or "").split(",")]
    return etag in known or "*" in known
