"""player_html: the player and a scene as one HTML file, which needs no server and sends no request."""

from __future__ import annotations

import base64
import html
import re
from typing import Final

from graings.player import WEB

# In the order in which each needs only those before it.
_MODULES: Final = (
    *(
        "camera",
        "scene_file",
        "shaders",
        "renderer",
        "sorter",
        "gestures",
        "bar",
        "link",
        "pictures",
        "resolution",
        "player",
    ),
    "page_start",
)
_IMPORT: Final = re.compile(r"^import\b[^;]*;\n", re.MULTILINE)
_EXPORT: Final = re.compile(r"^export ", re.MULTILINE)
# Nothing may be fetched; the worker and the server's pictures would be blobs.
_POLICY: Final = "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; worker-src blob:"

_PAGE: Final = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy" content="{policy}">
<title>{title}</title>
<style>
{style}</style>
</head>
<body>
<div id="player"></div>
<script id="worker" type="text/plain">
{worker}</script>
<script id="scene" type="text/plain">{scene}</script>
<script type="module">
{program}</script>
</body>
</html>
"""


def player_html(scene: bytes, title: str = "A scene in four dimensions") -> bytes:
    """The page that plays the scene file `scene` (`graings.player.scene_file.scene_bytes`)."""
    page = _PAGE.format(
        policy=_POLICY,
        title=html.escape(title),
        style=_text("player.css") + _text("page.css"),
        worker=_text("sort_worker.js"),
        scene=base64.b64encode(scene).decode(),
        program="\n".join(_plain(_text(f"{name}.js")) for name in _MODULES),
    )
    return page.encode()


def _text(name: str) -> str:
    return (WEB / name).read_text(encoding="utf-8")


def _plain(module: str) -> str:
    """A module's text for a page in which all modules are one."""
    return _EXPORT.sub("", _IMPORT.sub("", module))
