"""Scenes: the scene files of jobs, each written once for a checkpoint and kept beside the run."""

from __future__ import annotations

import hashlib
import threading
from pathlib import Path
from typing import Final

import graings
from graings.player import scene_file
from graings.storage.files import write_bytes
from service.rendering import LoadedModel

FOLDER: Final = "scenes"


class SceneFiles:
    """Writes scene files, one at a time: each takes a core for some seconds. May be used from several threads."""

    def __init__(self) -> None:
        self._guard = threading.Lock()

    def path(self, job: Path, loaded: LoadedModel) -> Path:
        """The scene file of the model of the job in the folder `job`; files of its earlier models are removed."""
        file = job / FOLDER / f"{scene_tag(loaded)}{scene_file.SUFFIX}"
        with self._guard:
            if not file.exists():
                data = scene_file.scene_bytes(loaded.model, loaded.scene)
                file.parent.mkdir(exist_ok=True)
                for old in file.parent.iterdir():
                    old.unlink()
                write_bytes(file, data)
        return file


def scene_tag(loaded: LoadedModel) -> str:
    """What the bytes of the scene file depend on."""
    return hashlib.sha256(f"{graings.__version__} {loaded.model.digest}".encode()).hexdigest()[:32]
