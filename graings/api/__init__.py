"""The Python interface: train, evaluate, render and export in a program. `import graings` shows these names.

Models are named by their path, as on the command line: the folder of a run, one of its checkpoints, or a `.graings`
file. Errors that a file or an option causes are `GraingsError`; a parameter out of range is a `ValueError`.
"""

from __future__ import annotations

from graings.api.scenes import export_model as export_model
from graings.api.scenes import open_scene as open_scene
from graings.api.scenes import render_video as render_video
from graings.api.scenes import render_view as render_view
from graings.api.scenes import save_image as save_image
from graings.api.training import evaluate_run as evaluate_run
from graings.api.training import load_capture as load_capture
from graings.api.training import synthesize as synthesize
from graings.api.training import train as train
from graings.errors import GraingsError as GraingsError
from graings.kernel import use_threads as use_threads
from graings.training.run import TrainingRun as TrainingRun
