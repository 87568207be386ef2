"""GrainGS: dynamic 3D Gaussian splatting on a CPU.

The names below are the Python interface (`graings.api`). They are imported at their first use, so that `import graings`
is fast and needs no torch.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from graings.api import GraingsError as GraingsError
    from graings.api import TrainingRun as TrainingRun
    from graings.api import evaluate_run as evaluate_run
    from graings.api import export_model as export_model
    from graings.api import load_capture as load_capture
    from graings.api import open_scene as open_scene
    from graings.api import render_video as render_video
    from graings.api import render_view as render_view
    from graings.api import save_image as save_image
    from graings.api import synthesize as synthesize
    from graings.api import train as train
    from graings.api import use_threads as use_threads

__version__ = "0.1.0"

__all__ = [
    "GraingsError",
    "TrainingRun",
    "evaluate_run",
    "export_model",
    "load_capture",
    "open_scene",
    "render_video",
    "render_view",
    "save_image",
    "synthesize",
    "train",
    "use_threads",
]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module 'graings' has no attribute {name!r}")
    return getattr(importlib.import_module("graings.api"), name)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
