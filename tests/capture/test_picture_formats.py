"""Formats and orientations of pictures: what OpenImageIO reads is read, the rest refused with the true reason."""

from __future__ import annotations

import json
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import pytest
from numpy.typing import NDArray
from PIL import Image

from graings.capture.image_file import SUFFIXES
from graings.capture.images import ImageStore
from graings.capture.load import load_capture
from graings.config import CaptureConfig
from graings.errors import CaptureError
from tests.capture.captures import pixels, write_dnerf, write_image, write_single

BLACK = (0.0, 0.0, 0.0)
# A lossy format, and one with a palette of 256 colours.
INEXACT = {".jpg": 16.0, ".jpeg": 16.0, ".jfif": 16.0, ".gif": 40.0}


def smooth(height: int = 12, width: int = 12, channels: int = 3) -> NDArray[np.uint8]:
    y, x = np.mgrid[:height, :width]
    planes = [20 * x, 20 * y, 10 * (x + y), 255 - 5 * x]
    return np.stack(planes[:channels], axis=2).astype(np.uint8)


def write_as(path: Path, image: NDArray[Any], **attributes: Any) -> Path:
    spec = oiio.ImageSpec(image.shape[1], image.shape[0], image.shape[2], "half" if path.suffix == ".exr" else "uint8")
    spec["compression"] = "lossless" if path.suffix == ".webp" else "jpeg:95" if path.suffix[1] == "j" else "none"
    spec["oiio:UnassociatedAlpha"] = 1
    for name, value in attributes.items():
        spec[name] = value
    output = oiio.ImageOutput.create(str(path))
    assert output is not None, oiio.geterror()
    assert output.open(str(path), spec), output.geterror()
    stored = image / np.float32(255) if path.suffix == ".exr" else image
    assert output.write_image(np.ascontiguousarray(stored)), output.geterror()
    assert output.close()
    return path


def replace_image(folder: Path, suffix: str, image: NDArray[Any], **attributes: Any) -> Path:
    """The picture r_002 of a D-NeRF capture as another file."""
    (folder / "train/r_002.png").unlink()
    return write_as(folder / f"train/r_002{suffix}", image, **attributes)


@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_a_picture_that_was_cut_from_a_larger_one_is_read(tmp_path: Path, suffix: str) -> None:
    """Image editors keep the offset of a crop (oFFs of PNG, XPosition of TIFF); the file holds the whole crop."""
    folder = write_dnerf(tmp_path)
    (folder / "train/r_002.png").unlink()
    file = folder / f"train/r_002{suffix}"
    if suffix == ".png":
        Image.fromarray(smooth()).save(file)
        offset, content = b"oFFs" + struct.pack(">iiB", 7, 5, 0), file.read_bytes()
        chunk = struct.pack(">I", 9) + offset + struct.pack(">I", zlib.crc32(offset))
        file.write_bytes(content[:33] + chunk + content[33:])  # after the signature and IHDR
    else:
        image = oiio.ImageBuf(oiio.ImageSpec(oiio.ROI(7, 19, 5, 17, 0, 1, 0, 3), "uint8"))
        image.set_pixels(image.roi, smooth() / np.float32(255))
        assert image.write(str(file)), image.geterror()
    stored = oiio.ImageInput.open(str(file)).spec()
    assert (stored.x, stored.y) == (7, 5)
    capture = load_capture(folder)
    rgb = ImageStore(BLACK).rgb(capture.train[2])
    np.testing.assert_allclose(rgb, smooth() / np.float32(255), atol=1e-3)


@pytest.mark.parametrize("suffix", [*SUFFIXES, ".PNG", ".JFIF", ".TIF"])
def test_pictures_of_any_format_are_read_under_a_name_without_suffix(tmp_path: Path, suffix: str) -> None:
    folder = write_dnerf(tmp_path)
    replace_image(folder, suffix.lower(), smooth()).rename(folder / f"train/r_002{suffix}")
    capture = load_capture(folder)
    assert capture.train[2].name == f"train/r_002{suffix}"
    image = 255 * ImageStore(BLACK).rgb(capture.train[2])
    assert np.abs(image - smooth()).max() <= INEXACT.get(suffix.lower(), 0.1)


def seen(folder: Path) -> tuple[NDArray[np.float32], NDArray[np.float32] | None]:
    """Colour on black and alpha of the picture r_002."""
    frame, images = load_capture(folder).train[2], ImageStore(BLACK)
    return images.rgb(frame), images.alpha(frame)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_transparent_pixels_show_what_the_format_says(tmp_path: Path, suffix: str) -> None:
    """Alpha from 0 to 1 over bright colours: straight in all formats but EXR, 0 or 1 in GIF, absent in JPEG."""
    straight = np.full((12, 12, 4), (250, 120, 30, 0), np.uint8)
    straight[..., 3] = np.arange(12) // 2 * 51
    folder = write_dnerf(tmp_path)
    if suffix == ".gif":  # OpenImageIO writes GIFs without transparency
        straight[..., 3] = np.where(straight[..., 3] > 100, 255, 0)
        (folder / "train/r_002.png").unlink()
        palette = Image.fromarray((straight[..., 3] // 255).astype(np.uint8), "P")
        palette.putpalette([*straight[0, 0, :3], *straight[0, 0, :3]])
        palette.save(folder / "train/r_002.gif", transparency=0)
    elif suffix == ".exr":
        premultiplied = straight / np.float32(255)
        premultiplied[..., :3] *= premultiplied[..., 3:]
        replace_image(folder, suffix, 255 * premultiplied)
    else:
        replace_image(folder, suffix, straight if has_alpha(suffix) else straight[..., :3])
    color, alpha = seen(folder)
    assert (alpha is not None) == has_alpha(suffix)
    expected = straight / np.float32(255)
    if alpha is not None:
        np.testing.assert_allclose(alpha, expected[..., 3], atol=1e-3)
        expected[..., :3] *= expected[..., 3:]
    np.testing.assert_allclose(color, expected[..., :3], atol=INEXACT.get(suffix, 0.25) / 255)


def has_alpha(suffix: str) -> bool:
    return suffix not in (".jpg", ".jpeg", ".jfif")


def bmp(path: Path, image: NDArray[np.uint8], *, declared: int | None = None) -> Path:
    """A BMP of 32 bits per pixel with the simplest header, or the fourth that `declared` the mask of alpha."""
    height, width = image.shape[:2]
    pixels = image[::-1, :, [2, 1, 0, 3]].tobytes()
    size = 40 if declared is None else 108
    header = struct.pack(
        "<IiiHHIIiiII", size, width, height, 1, 32, 0 if declared is None else 3, len(pixels), *[0] * 4
    )
    if declared is not None:
        header += struct.pack("<IIII", 0xFF0000, 0xFF00, 0xFF, declared) + b"BGRs" + bytes(48)
    path.write_bytes(b"BM" + struct.pack("<IHHI", 14 + size + len(pixels), 0, 0, 14 + size) + header + pixels)
    return path


@pytest.mark.parametrize("declared", [None, 0])
def test_a_bmp_whose_fourth_byte_is_unused_is_opaque(tmp_path: Path, declared: int | None) -> None:
    image = np.concatenate([smooth(), np.zeros((12, 12, 1), np.uint8)], axis=2)
    folder = write_dnerf(tmp_path)
    for index in range(4):
        (folder / f"train/r_{index:03d}.png").unlink()
        bmp(folder / f"train/r_{index:03d}.bmp", image, declared=declared)
    assert not load_capture(folder).has_alpha
    color, alpha = seen(folder)
    assert alpha is None
    np.testing.assert_allclose(color, image[..., :3] / 255, atol=1e-4)


def test_a_bmp_whose_header_declares_alpha_may_be_empty(tmp_path: Path) -> None:
    image = np.concatenate([smooth(), np.zeros((12, 12, 1), np.uint8)], axis=2)
    folder = write_dnerf(tmp_path)
    (folder / "train/r_002.png").unlink()
    bmp(folder / "train/r_002.bmp", image, declared=0xFF000000)
    color, alpha = seen(folder)
    assert alpha is not None
    assert (alpha.max(), color.max()) == (0, 0)


@pytest.mark.parametrize("suffix", [suffix for suffix in SUFFIXES if suffix != ".tga"])
def test_truncated_pictures_are_refused_when_the_capture_is_loaded(tmp_path: Path, suffix: str) -> None:
    folder = write_dnerf(tmp_path)
    path = replace_image(folder, suffix, pixels(64, 64, 3))
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(CaptureError, match=rf"^train/r_002\{suffix}: (is truncated|cannot be)"):
        load_capture(folder)


@pytest.mark.parametrize(("suffix", "brand"), [(".heic", b"heic"), (".HEIF".lower(), b"mif1"), (".avif", b"avif")])
def test_photo_containers_are_refused_with_the_true_reason(tmp_path: Path, suffix: str, brand: bytes) -> None:
    folder = write_dnerf(tmp_path)
    (folder / "train/r_002.png").unlink()
    (folder / f"train/r_002{suffix}").write_bytes(b"\0\0\0\x18ftyp" + brand + bytes(64))
    kind = "AVIF" if suffix == ".avif" else "HEIC"
    with pytest.raises(CaptureError, match=rf"^train/r_002\{suffix}: is a {kind} picture, which is not read") as caught:
        load_capture(folder)
    assert "Convert it to PNG or JPEG" in caught.value.remedy


def shown(image: NDArray[np.uint8], code: int) -> NDArray[np.uint8]:
    """`image` as OpenImageIO turns it for a viewer."""
    buffer = oiio.ImageBuf(image)
    buffer.specmod()["Orientation"] = code
    return np.asarray(oiio.ImageBufAlgo.reorient(buffer).get_pixels(oiio.UINT8))


def write_tagged(folder: Path, code: int, size: tuple[int, int], *, sizes: bool = True) -> Path:
    """A capture whose intrinsics are for `size` px, its pictures 64x40 px as stored with an EXIF orientation."""
    write_single(folder, 8)
    for index in range(8):
        path = folder / f"images/frame_{index:05d}.png"
        path.unlink()
        write_as(path.with_suffix(".tif"), smooth(40, 64), Orientation=code)
    path = folder / "transforms.json"
    document = json.loads(path.read_text())
    document.update(w=size[0], h=size[1])
    if not sizes:
        document = {key: value for key, value in document.items() if key not in ("w", "h")}
    path.write_text(json.dumps(document))
    return folder


@pytest.mark.parametrize("code", range(2, 9))
def test_a_picture_is_turned_where_the_camera_fits_only_the_turned_one(tmp_path: Path, code: int) -> None:
    upright = (40, 64) if code >= 5 else (64, 40)
    config = CaptureConfig(orientation="auto" if code >= 5 else "upright")
    capture = load_capture(write_tagged(tmp_path, code, upright), config)
    frame = capture.train[0]
    assert frame.source_size == upright
    image = 255 * ImageStore(BLACK).rgb(frame)
    np.testing.assert_allclose(image, shown(smooth(40, 64), code), atol=0.1)
    assert f"8 pictures are turned by their EXIF orientation ({code})" in capture.notes


@pytest.mark.parametrize("code", [3, 6])
def test_a_picture_is_used_as_stored_where_the_camera_fits_it_and_the_tag_is_named(tmp_path: Path, code: int) -> None:
    capture = load_capture(write_tagged(tmp_path, code, (64, 40)))
    image = 255 * ImageStore(BLACK).rgb(capture.train[0])
    np.testing.assert_allclose(image, smooth(40, 64), atol=0.1)
    (note,) = [note for note in capture.notes if "EXIF" in note]
    assert f"images/frame_00001.tif: {code}" in note
    assert "capture.orientation=upright" in note


def test_a_size_that_fits_neither_way_names_the_tag(tmp_path: Path) -> None:
    folder = write_tagged(tmp_path, 6, (64, 64))
    with pytest.raises(CaptureError, match=r"for 64x64 px, the image .* has 64x40 \(EXIF orientation 6\)"):
        load_capture(folder)


def test_a_turned_picture_has_its_mask_and_its_reduced_size(tmp_path: Path) -> None:
    folder = write_tagged(tmp_path, 6, (40, 64))
    path = folder / "transforms.json"
    document = json.loads(path.read_text())
    for frame in document["frames"]:
        frame["mask_path"] = "mask.png"
    path.write_text(json.dumps(document))
    valid = np.full((64, 40, 1), 255, np.uint8)
    valid[:32] = 0
    write_image(folder / "mask.png", valid)
    frame = load_capture(folder, CaptureConfig(max_side=32)).train[0]
    found = ImageStore(BLACK).valid(frame)
    assert found is not None
    assert found.shape == (32, 20)
    assert found[:, 0].tolist() == [False] * 16 + [True] * 16
