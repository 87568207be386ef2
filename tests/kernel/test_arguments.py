"""Arrays of the wrong type or shape are refused; results are never written to a copy that nobody sees."""

from __future__ import annotations

import pytest
import torch

from graings import kernel
from graings.raster.result import RasterSettings
from graings.scene.activations import sigmoid, tanh
from graings.scene.encoding import direction_encoding, frequency_encoding


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.int64])
def test_other_types_are_refused(dtype: torch.dtype) -> None:
    for function in (tanh, sigmoid, lambda values: frequency_encoding(values.view(-1, 1), 2)):
        with pytest.raises((TypeError, ValueError)):
            function(torch.arange(4).to(dtype))


def test_inputs_of_mixed_types_are_converted_to_that_of_the_output() -> None:
    directions = torch.nn.functional.normalize(torch.randn(5, 3, dtype=torch.float64), dim=-1)
    normals = torch.randn(5, 3)
    assert torch.equal(direction_encoding(directions, 2, normals), direction_encoding(directions, 2, normals.double()))


def test_positions_of_another_shape_are_refused_before_they_are_read() -> None:
    log_scales, offsets, children = torch.zeros(2, 3), torch.zeros(2, 4, 3), torch.arange(8)
    outputs = [torch.zeros(8, 7), torch.zeros(8, 3), torch.zeros(8, 3)]
    with pytest.raises(ValueError, match="position must have 6 elements"):
        kernel.call("gather", torch.zeros(2, 1), log_scales, offsets, children, *outputs, 1)


def test_a_cap_of_alpha_that_is_one_in_float32_is_refused() -> None:
    RasterSettings(alpha_max=1 - 1e-7)
    with pytest.raises(ValueError, match="alpha_max < 1"):
        RasterSettings(alpha_max=1 - 1e-8)
