"""Pictures of colour, transparency and depth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest

from graings.export.picture import Content, picture
from graings.image_encoding import ImageFormat, encode_image
from graings.render import render
from tests.export.models import UNITS, ring, tiny_model

WHITE = (1.0, 1.0, 1.0)


def read(data: bytes, format: str, folder: Path) -> tuple[oiio.ImageSpec, np.ndarray]:
    path = folder / f"a.{format}"
    path.write_bytes(data)
    config = oiio.ImageSpec()
    config.attribute("oiio:UnassociatedAlpha", 1)
    file = oiio.ImageInput.open(str(path), config)
    pixels = file.read_image(oiio.FLOAT)
    assert isinstance(pixels, np.ndarray)
    return file.spec(), pixels


def shown(content: Content, format: ImageFormat) -> bytes:
    return picture(tiny_model().scene, ring(3)[0], 0.3, WHITE, UNITS, content, format)


def test_colour_is_that_of_render() -> None:
    expected = render(tiny_model().scene, ring(3)[0], 0.3, WHITE).color.numpy()
    assert shown("color", "png") == encode_image(expected, "png")


@pytest.mark.parametrize(("format", "error"), [("png", 2.5 / 255), ("webp", 0.15), ("exr", 2e-3)])
def test_a_transparent_picture_over_a_background_is_the_opaque_one(
    format: ImageFormat, error: float, tmp_path: Path
) -> None:
    spec, pixels = read(shown("rgba", format), format, tmp_path)
    assert spec.channelnames == ("R", "G", "B", "A")
    color, alpha = pixels[..., :3], pixels[..., 3:]
    premultiplied = color if format == "exr" else color * alpha
    expected = render(tiny_model().scene, ring(3)[0], 0.3, WHITE).color.numpy()
    assert np.abs(premultiplied + 1 - alpha - expected).max() < error
    assert alpha.min() < 0.01
    assert alpha.max() > 0.5


def test_depth_is_in_the_captures_units_along_the_axis(tmp_path: Path) -> None:
    spec, pixels = read(shown("depth", "exr"), "exr", tmp_path)
    assert (spec.channelnames, spec.format) == (("Z",), oiio.TypeDesc("float"))
    there = pixels[..., 0] > 0
    assert 0 < there.sum() < there.size
    depths = pixels[..., 0][there]  # the camera is 2 normalised units from a ball of about 1
    assert 1 / UNITS.scale < depths.min() < depths.max() < 3 / UNITS.scale
    drawn = render(tiny_model().scene, ring(3)[0], 0.3, WHITE, depth=True)
    assert drawn.depth is not None
    expected = (drawn.depth / drawn.alpha).numpy()[there] / UNITS.scale
    np.testing.assert_allclose(depths, expected, rtol=1e-5)


def test_a_picture_of_depth_is_white_where_near_and_black_where_nothing_is(tmp_path: Path) -> None:
    _, depth = read(shown("depth", "exr"), "exr", tmp_path)
    _, grey = read(shown("depth", "png"), "png", tmp_path)
    assert grey.shape == (*depth.shape[:2], 1)
    assert grey.flat[np.where(depth > 0, depth, np.inf).argmin()] == 1.0
    assert np.all((grey == 0) == (depth == 0))


def test_layers_are_one_file(tmp_path: Path) -> None:
    spec, pixels = read(shown("layers", "exr"), "exr", tmp_path)
    assert spec.channelnames == ("R", "G", "B", "A", "Z")
    assert [str(kind) for kind in spec.channelformats] == ["half"] * 4 + ["float"]
    _, alone = read(shown("depth", "exr"), "exr", tmp_path)
    np.testing.assert_array_equal(pixels[..., 4:], alone)


def test_alpha_is_grey_in_every_format(tmp_path: Path) -> None:
    alpha = render(tiny_model().scene, ring(3)[0], 0.3, WHITE).alpha.numpy()
    for format, error in (("png", 0.5 / 255 + 1e-6), ("exr", 1e-3), ("jpeg", 0.1), ("webp", 0.1)):
        _, pixels = read(shown("alpha", format), format, tmp_path)
        assert np.abs(pixels[..., 0] - alpha).max() < error


@pytest.mark.parametrize(("content", "format"), [("layers", "png"), ("rgba", "jpeg")])
def test_a_format_that_cannot_hold_it_is_refused(content: Content, format: ImageFormat) -> None:
    with pytest.raises(ValueError, match="exr"):
        shown(content, format)
