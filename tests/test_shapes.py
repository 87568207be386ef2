"""Shape annotations: they are checked while tests run, hold on valid calls, and refuse tensors of a wrong shape."""

from __future__ import annotations

import ast
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from jaxtyping import TypeCheckError, jaxtyped

from graings.gaussians import Gaussians
from graings.raster import photometric, photometric_reference, rasterize, reference
from tests.models import tiny_scene
from tests.scenes import gaussians, pinhole
from tests.shapes import checked

PACKAGES = Path(__file__).resolve().parent.parent / "graings"


@pytest.mark.parametrize("time", [torch.tensor(0.5), torch.tensor([[0.5]]), torch.tensor([0.2, 0.5])])
def test_a_time_that_is_not_a_vector_of_one_number_is_refused(time: torch.Tensor) -> None:
    scene = tiny_scene(anchors=4)
    assert scene.residual is not None
    part, directions = scene.residual.part(scene.scaffold.features), torch.nn.functional.normalize(torch.ones(4, 3))
    assert scene.residual(part, torch.tensor([0.5]), directions).shape == (4, 3, 4)
    with pytest.raises(TypeCheckError, match="parameter 'time'"):
        scene.residual(part, time, directions)


def test_every_dimension_of_a_shape_is_written_as_a_string() -> None:
    """`Float[Tensor, 1]` accepts any tensor: jaxtyping reads dimensions from a string only."""
    unquoted = [
        f"{path.relative_to(PACKAGES)}:{node.lineno}"
        for path in sorted(PACKAGES.rglob("*.py"))
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Subscript)
        and isinstance(node.value, ast.Name)
        and node.value.id in ("Bool", "Float", "Float32", "Float64", "Int", "Int32", "Int64", "Shaped", "UInt8")
        and isinstance(node.slice, ast.Tuple)
        and not (isinstance(node.slice.elts[1], ast.Constant) and isinstance(node.slice.elts[1].value, str))
    ]
    assert unquoted == []


# The rasterizer raises ValueErrors of its own for wrong shapes, and other tests expect them. The import hook would
# raise first, so it does not cover `graings.raster`; these tests check its annotations instead.


def draw(function: Callable[..., Any], batch: Gaussians, **arguments: Any) -> Any:
    valid = {"background": torch.ones(3), "means2d_offset": torch.zeros(len(batch), 2)}
    return jaxtyped(typechecker=checked)(function)(batch, pinhole(20, 10), **valid | arguments)


@pytest.mark.parametrize("module", [rasterize, reference])
def test_the_shapes_of_a_rasterizer_hold(module: Any) -> None:
    batch = gaussians(5, 1)
    batch = Gaussians(
        *(getattr(batch, n).float() for n in ("means", "quats", "log_scales", "opacities", "colors")), batch.uids
    )
    result = draw(module.rasterize, batch)
    assert (result.color.shape, result.alpha.shape, result.depth.shape) == ((10, 20, 3), (10, 20), (10, 20))
    assert result.means2d.shape == result.radii.shape == (5, 2)
    draw(module.rasterize, batch, means2d_offset=None)
    for wrong in (
        {"background": torch.ones(4)},
        {"background": torch.ones(3, 1)},
        {"means2d_offset": torch.zeros(5, 3)},
    ):
        with pytest.raises(TypeCheckError, match=next(iter(wrong))):
            draw(module.rasterize, batch, **wrong)


@pytest.mark.parametrize("module", [photometric, photometric_reference])
def test_the_shapes_of_the_photometric_loss_hold(module: Any) -> None:
    image = torch.rand(6, 5, 3)
    for function, weights in ((module.ssim, ()), (module.photometric, (0.2, 1.0))):
        wrapped = jaxtyped(typechecker=checked)(function)
        assert wrapped(image, image, *weights).shape == ()
        for first, second in ((image[..., :2], image[..., :2]), (image, image[:5]), (image[0], image[0])):
            with pytest.raises(TypeCheckError):
                wrapped(first, second, *weights)
