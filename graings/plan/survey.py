"""survey: the plan of a capture folder, without training."""

from __future__ import annotations

from pathlib import Path

from graings.capture.background import with_background
from graings.capture.images import ImageStore
from graings.capture.load import load_capture
from graings.config import TrainConfig, make_config
from graings.plan.capture_statistics import measure
from graings.plan.cost import Calibration
from graings.plan.plan import Plan, make_plan

COMPARED: tuple[str, ...] = ("draft", "standard", "fine")  # those that a capture of one's own may want


def survey(capture: Path, config: TrainConfig, calibration: Calibration | None) -> Plan:
    """Read the capture in the folder `capture`, measure it, and plan a training with `config`.

    The plan names the cost of other presets too. Raises `CaptureError` for the capture.
    """
    data = load_capture(capture, config.capture)
    seen = with_background(config.capture, data)
    images = ImageStore(seen.background_rgb(), seen.cache_mb)
    others = [make_config(name, {"capture": config.capture.model_dump()}) for name in COMPARED]
    return make_plan(measure(data, images, seen.background_rgb()), config, calibration, others)
