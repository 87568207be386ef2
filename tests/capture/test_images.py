"""Decoding, compositing, shrinking and the cache of ImageStore."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import pytest
from numpy.typing import NDArray

from graings.camera.camera import Camera
from graings.capture.capture import Frame
from graings.capture.image_file import check_image
from graings.capture.images import ImageStore, shrink
from graings.errors import CaptureError
from tests.capture.captures import pixels, write_image

BLUE = (0.0, 0.25, 1.0)
HALF_A_STEP = 0.5 / 65535  # rounding error of 16 bits


def frame_of(path: Path, *, size: tuple[int, int] | None = None) -> Frame:
    """The frame of one image, as the file has it or at `size` (width, height)."""
    image = check_image(path, path.name, path.read_bytes())
    camera = Camera(np.eye(4), 10.0, 10.0, 5.0, 5.0, *(size or (image.width, image.height)))
    return Frame(path.name, camera, 0.0, path, (image.width, image.height))


def composite(straight: NDArray[Any], background: tuple[float, float, float]) -> NDArray[np.float64]:
    """Reference in float64 from RGBA in [0, 1]."""
    alpha = straight[..., 3:]
    return straight[..., :3] * alpha + np.array(background) * (1 - alpha)


def test_eight_bit_opaque_pixels_are_exactly_x_over_255(tmp_path: Path) -> None:
    image = pixels(7, 9, 3)
    rgb = ImageStore(BLUE).rgb(frame_of(write_image(tmp_path / "a.png", image)))
    assert rgb.dtype == np.float32
    np.testing.assert_array_equal(rgb, image.astype(np.float32) / np.float32(255))


def test_straight_alpha_is_composited_on_the_background(tmp_path: Path) -> None:
    image = pixels(7, 9)
    image[0, 0] = (200, 100, 50, 0)  # colour under alpha 0 must not be visible
    image[0, 1] = (200, 100, 50, 255)
    store, frame = ImageStore(BLUE), frame_of(write_image(tmp_path / "a.png", image))
    rgb, alpha = store.rgb(frame), store.alpha(frame)
    # Plus five float32 roundings of numbers up to 1. Values quantized as the background become exactly the background.
    error, background = np.abs(rgb - composite(image / 255, BLUE)), rgb == np.float32(BLUE)
    assert error[~background].max() <= HALF_A_STEP + 5 * 2**-24
    assert error[background].max() <= 2 * HALF_A_STEP + 5 * 2**-24
    np.testing.assert_array_equal(rgb[0, 0], np.float32(BLUE))
    np.testing.assert_array_equal(rgb[0, 1], image[0, 1, :3].astype(np.float32) / np.float32(255))
    assert alpha is not None
    np.testing.assert_array_equal(alpha, image[..., 3].astype(np.float32) / np.float32(255))


@pytest.mark.parametrize("size", [(9, 7), (4, 3)])
def test_alpha_that_is_opaque_everywhere_counts_as_none(tmp_path: Path, size: tuple[int, int]) -> None:
    image = pixels(7, 9)
    image[..., 3] = 255
    opaque, plain = (write_image(tmp_path / name, each) for name, each in (("a.png", image), ("b.png", image[..., :3])))
    store = ImageStore(BLUE)
    assert store.alpha(frame_of(opaque, size=size)) is None
    np.testing.assert_array_equal(store.rgb(frame_of(opaque, size=size)), store.rgb(frame_of(plain, size=size)))
    image[3, 3, 3] = 254
    assert store.alpha(frame_of(write_image(tmp_path / "c.png", image))) is not None


def test_sixteen_bit_pixels_keep_their_precision(tmp_path: Path) -> None:
    image = np.arange(60, dtype=np.uint16).reshape(4, 5, 3) * 1000 + 7
    rgb = ImageStore(BLUE).rgb(frame_of(write_image(tmp_path / "a.png", image)))
    np.testing.assert_array_equal(rgb, image.astype(np.float32) / np.float32(65535))


def test_exr_is_linear_clipped_and_already_premultiplied(tmp_path: Path) -> None:
    image = np.array([[[0.5, 0.25, 0.0, 0.5], [2.0, 1.0, -1.0, 1.0]]], dtype=np.float32)
    rgb = ImageStore(BLUE).rgb(frame_of(write_image(tmp_path / "a.exr", image, "float")))
    np.testing.assert_allclose(rgb[0], [[0.5, 0.375, 0.5], [1.0, 1.0, 0.0]], rtol=0, atol=HALF_A_STEP + 2**-23)


def test_jpeg_is_read_without_alpha(tmp_path: Path) -> None:
    image = np.full((16, 16, 3), (200, 100, 50), dtype=np.uint8)
    store, frame = ImageStore(BLUE), frame_of(write_image(tmp_path / "a.jpg", image))
    # A flat colour survives JPEG up to the rounding of its YCbCr transform.
    np.testing.assert_allclose(store.rgb(frame) * 255, image, rtol=0, atol=2)
    assert store.alpha(frame) is None


@pytest.mark.parametrize("channels", [1, 2])
def test_grey_becomes_rgb(tmp_path: Path, channels: int) -> None:
    image = pixels(5, 6, channels)
    rgb = ImageStore((0.0, 0.0, 0.0)).rgb(frame_of(write_image(tmp_path / "a.png", image)))
    expected = image[..., 0] / 255 * (image[..., 1] / 255 if channels == 2 else 1.0)
    np.testing.assert_allclose(rgb, np.repeat(expected[..., None], 3, axis=2), rtol=0, atol=HALF_A_STEP + 3 * 2**-24)


def test_format_is_recognised_by_content_not_by_name(tmp_path: Path) -> None:
    image = pixels(7, 9, 3)
    path = write_image(tmp_path / "a.png", image).rename(tmp_path / "a.jpg")
    np.testing.assert_array_equal(ImageStore(BLUE).rgb(frame_of(path)), image.astype(np.float32) / np.float32(255))


@pytest.mark.parametrize(
    ("source", "target"), [((6, 8), (3, 4)), ((7, 9), (3, 4)), ((11, 5), (4, 5)), ((5, 7), (1, 1))]
)
def test_shrinking_is_the_exact_area_average(source: tuple[int, int], target: tuple[int, int]) -> None:
    image = pixels(*source).astype(np.float32)

    def overlap(size: int, cells: int, cell: int, pixel: int) -> Fraction:
        low = max(Fraction(cell * size, cells), Fraction(pixel))
        high = min(Fraction((cell + 1) * size, cells), Fraction(pixel + 1))
        return max(high - low, Fraction(0)) * Fraction(cells, size)

    for row in range(target[0]):
        for column in range(target[1]):
            expected = sum(
                overlap(source[0], target[0], row, y) * overlap(source[1], target[1], column, x) * int(image[y, x, 0])
                for y in range(source[0])
                for x in range(source[1])
            )
            value = shrink(image, target[1], target[0])[row, column, 0]
            assert value == pytest.approx(float(expected), rel=2**-23)


def test_shrinking_weights_colour_by_alpha(tmp_path: Path) -> None:
    image = np.zeros((2, 2, 4), dtype=np.uint8)
    image[0, 0] = (255, 0, 0, 255)
    image[0, 1] = (0, 255, 0, 0)  # invisible green
    path = write_image(tmp_path / "a.png", image)
    store = ImageStore((0.0, 0.0, 0.0))
    rgb = store.rgb(frame_of(path, size=(1, 1)))[0, 0]
    np.testing.assert_allclose(rgb, [0.25, 0, 0], rtol=0, atol=HALF_A_STEP + 2**-24)
    assert rgb[1] == rgb[2] == 0
    alpha = store.alpha(frame_of(path, size=(1, 1)))
    assert alpha is not None
    assert alpha[0, 0] == rgb[0]


def test_cache_stays_within_its_limit_and_needs_no_file(tmp_path: Path) -> None:
    store = ImageStore(BLUE, cache_mb=1)
    frames = [
        frame_of(write_image(tmp_path / f"{i}.png", pixels(210, 210, 3, seed=i))) for i in range(8)
    ]  # 265 kB each
    for frame in frames:
        last = store.rgb(frame)
        assert store.cached_bytes <= 1_000_000
    assert store.cached_bytes > 500_000
    frames[-1].image_path.unlink()
    np.testing.assert_array_equal(store.rgb(frames[-1]), last)  # the file is gone, so it comes from the cache
    last[:] = 0  # a copy of the caller
    assert store.rgb(frames[-1]).any()


def test_image_larger_than_the_cache_is_still_returned(tmp_path: Path) -> None:
    store = ImageStore(BLUE, cache_mb=1)
    image = pixels(500, 500, 3)  # 1.5 MB
    assert store.rgb(frame_of(write_image(tmp_path / "a.png", image))).shape == (500, 500, 3)
    assert store.cached_bytes == 0


def test_a_prefetched_frame_is_decoded_once_even_if_it_exceeds_the_cache(tmp_path: Path) -> None:
    frame = frame_of(write_image(tmp_path / "a.png", pixels(700, 700, 3)))  # more than a megabyte
    expected = ImageStore(BLUE).rgb(frame)
    store = ImageStore(BLUE, cache_mb=1)
    store.prefetch(frame)
    store.prefetch(frame)
    store._prefetcher.shutdown()  # waits until it is done
    frame.image_path.unlink()
    np.testing.assert_array_equal(store.rgb(frame), expected)
    with pytest.raises(CaptureError):  # returned once, not cached, and the file is gone
        store.rgb(frame)


def test_an_error_of_prefetching_is_raised_when_the_frame_is_requested(tmp_path: Path) -> None:
    frame = frame_of(write_image(tmp_path / "a.png", pixels(7, 9)))
    frame.image_path.write_bytes(frame.image_path.read_bytes()[:-60])
    store = ImageStore(BLUE)
    store.prefetch(frame)
    with pytest.raises(CaptureError, match=r"a\.png: cannot be decoded"):
        store.rgb(frame)


def test_threads_see_the_same_pixels(tmp_path: Path) -> None:
    frames = [frame_of(write_image(tmp_path / f"{i}.png", pixels(40, 40, seed=i)), size=(17, 17)) for i in range(6)]
    expected = [ImageStore(BLUE).rgb(frame) for frame in frames]
    store = ImageStore(BLUE, cache_mb=1)
    with ThreadPoolExecutor(4) as pool:
        images = list(pool.map(store.rgb, frames * 5))
    for index, rgb in enumerate(images):
        np.testing.assert_array_equal(rgb, expected[index % 6])


def test_file_that_changed_size_after_loading_is_refused(tmp_path: Path) -> None:
    frame = frame_of(write_image(tmp_path / "a.png", pixels(7, 9)))
    write_image(tmp_path / "a.png", pixels(9, 7))
    with pytest.raises(CaptureError, match=r"a\.png, size: is 7x9 px, was 9x7 before"):
        ImageStore(BLUE).rgb(frame)


def test_file_that_was_damaged_after_loading_is_refused(tmp_path: Path) -> None:
    frame = frame_of(write_image(tmp_path / "a.png", pixels(7, 9)))
    frame.image_path.write_bytes(frame.image_path.read_bytes()[:-60])
    with pytest.raises(CaptureError, match=r"a\.png: cannot be decoded"):
        ImageStore(BLUE).rgb(frame)


def test_huge_image_is_refused_by_its_header(tmp_path: Path) -> None:
    path = tmp_path / "bomb.png"
    output = oiio.ImageOutput.create(str(path))
    assert output.open(str(path), oiio.ImageSpec(20_000, 4, 1, "uint8"))
    assert output.write_image(np.zeros((4, 20_000, 1), dtype=np.uint8))
    assert output.close()
    with pytest.raises(CaptureError, match="is 20000x4 px, more than 16384 px per side"):
        check_image(path, path.name, path.read_bytes())
