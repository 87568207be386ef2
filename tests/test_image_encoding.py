from __future__ import annotations

from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest

from graings.image_encoding import FORMATS, MEDIA_TYPES, ImageFormat, encode_image, image_format

SIGNATURES = {"png": b"\x89PNG", "jpeg": b"\xff\xd8\xff", "webp": b"RIFF", "exr": b"\x76\x2f\x31\x01"}


def gradient(height: int = 24, width: int = 32) -> np.ndarray:
    v, u = np.mgrid[0:height, 0:width]
    return np.stack([u / width, v / height, (u + v) / (width + height)], axis=-1).astype(np.float32)


def decode(data: bytes, format: ImageFormat, folder: Path) -> np.ndarray:
    path = folder / f"image.{format}"
    path.write_bytes(data)
    pixels = oiio.ImageBuf(str(path)).get_pixels(oiio.FLOAT)
    assert isinstance(pixels, np.ndarray)
    return pixels


@pytest.mark.parametrize("format", FORMATS)
def test_every_format_starts_with_its_signature_and_keeps_the_size(format: ImageFormat, tmp_path: Path) -> None:
    data = encode_image(gradient(), format)
    assert data.startswith(SIGNATURES[format])
    assert decode(data, format, tmp_path).shape == (24, 32, 3)


def test_png_holds_the_nearest_eight_bit_values(tmp_path: Path) -> None:
    image = gradient()
    decoded = decode(encode_image(image, "png"), "png", tmp_path)
    np.testing.assert_array_equal(np.rint(decoded * 255.0), np.rint(image * 255.0))


@pytest.mark.parametrize("level", [None, 0, 1, 6, 9])
@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (9, 1), (130, 257)])
def test_png_keeps_every_pixel_at_every_level(shape: tuple[int, int], level: int | None, tmp_path: Path) -> None:
    """Noise beside a plain part: rows that differ in both directions, and runs longer than deflate's 258."""
    levels = np.random.default_rng(0).integers(0, 256, (*shape, 3))
    levels[shape[0] // 2 :] = 17
    data = encode_image(levels / 255.0, "png", png_level=level)
    decoded = decode(data, "png", tmp_path)
    np.testing.assert_array_equal(np.rint(decoded * 255.0).reshape(levels.shape), levels)


def test_a_higher_png_level_is_smaller_and_for_png_only() -> None:
    image = gradient(200, 300)
    stored, fast, small = (len(encode_image(image, png_level=level)) for level in (0, 1, 9))
    assert small < fast < stored
    assert len(encode_image(image)) < stored / 4
    for level, format in ((10, "png"), (-1, "png"), (3, "jpeg")):
        with pytest.raises(ValueError, match="png_level"):
            encode_image(image, image_format(format), png_level=level)


def test_exr_holds_half_floats_even_outside_the_unit_range(tmp_path: Path) -> None:
    image = gradient() * 3.0 - 1.0
    decoded = decode(encode_image(image, "exr"), "exr", tmp_path)
    np.testing.assert_array_equal(decoded, image.astype(np.float16).astype(np.float32))


@pytest.mark.parametrize("format", ["jpeg", "webp"])
def test_lossy_formats_stay_close_and_shrink_with_quality(format: ImageFormat, tmp_path: Path) -> None:
    image = gradient(64, 64)
    fine, coarse = encode_image(image, format, quality=95), encode_image(image, format, quality=10)
    assert len(coarse) < len(fine)
    assert np.abs(decode(fine, format, tmp_path) - image).mean() < 2.0 / 255.0


def test_eight_bit_formats_clip_what_they_cannot_hold(tmp_path: Path) -> None:
    image = np.array([[[-1.0, 0.5, 2.0]]], dtype=np.float32)
    np.testing.assert_array_equal(
        np.rint(decode(encode_image(image, "png"), "png", tmp_path) * 255.0), [[[0.0, 128.0, 255.0]]]
    )


@pytest.mark.parametrize(
    ("name", "format"), [("png", "png"), (".JPG", "jpeg"), ("image/webp", "webp"), ("image/x-exr", "exr")]
)
def test_a_format_is_known_by_name_suffix_and_media_type(name: str, format: ImageFormat) -> None:
    assert image_format(name) == format
    assert MEDIA_TYPES[image_format(name)].startswith("image/")


def test_an_unknown_format_is_refused_with_the_known_ones() -> None:
    with pytest.raises(ValueError, match="png, jpeg, webp, exr"):
        image_format("gif")
    with pytest.raises(ValueError, match="png, jpeg, webp, exr"):
        encode_image(gradient(), "gif")  # type: ignore[arg-type]


def test_invalid_images_and_qualities_are_refused() -> None:
    with pytest.raises(ValueError, match="shape"):
        encode_image(np.zeros((4, 4)))
    with pytest.raises(ValueError, match="finite"):
        encode_image(np.full((4, 4, 3), np.inf))
    with pytest.raises(ValueError, match="quality"):
        encode_image(gradient(), "jpeg", quality=0)
    with pytest.raises(ValueError, match="quality"):
        encode_image(gradient(), "png", quality=50)
