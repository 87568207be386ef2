"""Player: a trained scene as one small file that a browser plays, the player itself (`web/`), and both in one page."""

from pathlib import Path
from typing import Final

WEB: Final = Path(__file__).resolve().parent / "web"
