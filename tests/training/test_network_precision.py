"""Precision of the networks' products in training."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from graings import kernel
from graings.capture.images import ImageStore
from graings.capture.load import load_capture
from graings.capture.synthetic import write_synthetic
from graings.config import make_config
from graings.errors import KernelError
from graings.training.network_precision import rounds_products
from graings.training.trainer import Trainer

needs_amx = pytest.mark.skipif(not kernel.has_bfloat16_products(), reason="this CPU has no AMX")


def trainer(folder: Path, precision: str) -> Trainer:
    options = {"iterations": 40, "warmup": 0, "init.max_points": 200, "network_precision": precision}
    config = make_config("draft", options)
    capture = load_capture(folder, config.capture)
    return Trainer.start(capture, ImageStore(config.capture.background_rgb()), config)


def test_auto_rounds_where_the_cpu_can_and_float32_never_does(isa: str) -> None:
    available = kernel.has_bfloat16_products()
    assert rounds_products(make_config("standard")) is available
    assert rounds_products(make_config("standard", {"network_precision": "float32"})) is False
    assert rounds_products(make_config("paper")) is False
    if not available:
        with pytest.raises(KernelError, match="network_precision: this CPU has no AMX"):
            rounds_products(make_config("standard", {"network_precision": "bfloat16"}))


@needs_amx
def test_training_rounds_products_and_drawing_does_not(tmp_path: Path) -> None:
    capture = write_synthetic(tmp_path, frames=6, size=48)
    one, other = trainer(capture, "bfloat16"), trainer(capture, "float32")
    losses = [(one.step().loss, other.step().loss) for _ in range(10)]
    assert losses[0][0] == pytest.approx(losses[0][1], rel=0.01)
    assert losses[0][0] != losses[0][1]
    assert losses[-1][0] == pytest.approx(losses[-1][1], rel=0.1)
    other.scene.load_state_dict(one.scene.state_dict())
    with torch.no_grad():
        center, time = one.capture.train[0].camera.center, one.capture.train[0].time
        drawn = [t.scene.compose_together([(center, time)])[0].gaussians.means for t in (one, other)]
    assert torch.equal(*drawn)
