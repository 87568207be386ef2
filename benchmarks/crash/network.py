"""A network of its own for one process, on a link that can be cut: what happens when a machine disappears.

Packets are dropped in silence while the link is cut, as after a power failure, and no connection is closed. Needs root
and `ip` (iproute2).
"""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager

HERE, THERE = "10.213.7.1", "10.213.7.2"
_NAME, _OUTSIDE, _INSIDE = "graings-crash", "gcrash0", "gcrash1"


class Link:
    """The connection between this machine (`HERE`) and the processes behind `prefix` (`THERE`)."""

    prefix = ("ip", "netns", "exec", _NAME)

    def cut(self) -> None:
        _ip("-n", _NAME, "link", "set", _INSIDE, "down")

    def mend(self) -> None:
        _ip("-n", _NAME, "link", "set", _INSIDE, "up")


def unavailable() -> str | None:
    """Why there can be no such network here; None if there can."""
    if os.geteuid() != 0 or shutil.which("ip") is None:
        return "needs root and ip (iproute2)"
    return None


@contextmanager
def link() -> Iterator[Link]:
    """A network for as long as the context lasts."""
    _ip("netns", "add", _NAME)
    try:
        _ip("link", "add", _OUTSIDE, "type", "veth", "peer", "name", _INSIDE, "netns", _NAME)
        _ip("address", "add", f"{HERE}/30", "dev", _OUTSIDE)
        _ip("link", "set", _OUTSIDE, "up")
        _ip("-n", _NAME, "address", "add", f"{THERE}/30", "dev", _INSIDE)
        for name in (_INSIDE, "lo"):
            _ip("-n", _NAME, "link", "set", name, "up")
        yield Link()
        # A network lives on while processes in it end, and its link with it: the next one needs the name.
        _ip("link", "delete", _OUTSIDE)
    finally:
        _ip("netns", "delete", _NAME)


def _ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], check=True)
