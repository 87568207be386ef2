"""Files of splats: written, read back and drawn as before."""

from __future__ import annotations

import io
import json
import math
import struct
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import gaussforge
import numpy as np
import pytest
import torch
from plyfile import PlyData
from torch import Tensor

from graings.camera.camera import Camera
from graings.camera.units import Units
from graings.errors import CheckpointError
from graings.export.export import FORMATS, SEVERAL, WHOLE, ExportRequest, check_used, export_format, export_splats
from graings.export.formats import READABLE, WRITERS, half_turn, read_splats
from graings.export.harmonics_fit import fit_splats
from graings.export.selection import Selection
from graings.export.shown import open_shown
from graings.render import PreparedScene, render
from graings.scene.splats import Splats
from tests.export.models import SIZE, UNITS, ring, tiny_model
from tests.export.test_harmonics_fit import psnr, random_splats

WHITE = (1.0, 1.0, 1.0)

# dB that a format must keep: 8 bits a value cost more than floats, and .splat has no view dependence.
KEEPS = {"ply": 90, "compressed.ply": 40, "spz": 34, "sog": 32}


def seen(splats: Splats, units: Units) -> list[Tensor]:
    """Images by the same cameras of the capture, whatever units the splats are normalised with."""
    images = []
    for camera in ring(3):
        pose = units.camera(UNITS.camera_back(camera))
        lens = (camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height)
        images.append(render(splats, Camera(pose, *lens), 0.0, WHITE).color)
    return images


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("format", KEEPS)
def test_a_file_that_is_read_again_looks_the_same(format: str, degree: int, tmp_path: Path) -> None:
    splats = replace(random_splats(200, degree), sampling=None)
    file = tmp_path / f"a.{format}"
    file.write_bytes(WRITERS[format](splats, UNITS))
    again, units = read_splats(file)
    assert len(again) == 200
    assert again.degree == degree
    for before, after in zip(seen(splats, UNITS), seen(again, units), strict=True):
        assert psnr(before, after) > KEEPS[format]


def test_an_spz_has_the_axes_of_its_specification() -> None:
    """PLY: x right, y down, z forward. SPZ: x right, y up, z back."""
    splats = random_splats(50, 2)
    data = gaussforge.GaussForge().convert(WRITERS["spz"](splats, UNITS), "spz", "ply")["data"]
    rows = PlyData.read(io.BytesIO(data))["vertex"].data
    expected = splats.means.numpy() / UNITS.scale + np.array(UNITS.center)
    np.testing.assert_allclose(np.stack([rows["x"], -rows["y"], -rows["z"]], 1), expected, atol=1e-3)
    turned, units = half_turn(*half_turn(splats, UNITS))
    assert units == UNITS
    assert torch.equal(turned.harmonics, splats.harmonics)


def test_a_ply_has_the_columns_of_3dgs_in_the_captures_units() -> None:
    splats = random_splats(5, 3)
    rows = PlyData.read(io.BytesIO(WRITERS["ply"](splats, UNITS)))["vertex"].data
    positions = np.stack([rows[name] for name in "xyz"], 1)
    np.testing.assert_allclose(positions, splats.means.numpy() / UNITS.scale + np.array(UNITS.center), rtol=1e-5)
    np.testing.assert_allclose(rows["scale_1"], splats.log_scales[:, 1].numpy() - math.log(UNITS.scale), rtol=1e-5)
    np.testing.assert_allclose(1 / (1 + np.exp(-rows["opacity"])), splats.opacities.numpy(), rtol=1e-4)
    np.testing.assert_allclose(rows["f_dc_2"], splats.harmonics[:, 0, 2].numpy(), rtol=1e-6)
    np.testing.assert_allclose(rows["f_rest_16"], splats.harmonics[:, 2, 1].numpy(), rtol=1e-6)  # green comes second
    lengths = sum(rows[f"rot_{index}"].astype(np.float64) ** 2 for index in range(4))
    np.testing.assert_allclose(lengths, 1.0, rtol=1e-6)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_a_ply_has_the_fixed_layout_that_the_viewer_of_the_authors_of_3dgs_reads(degree: int) -> None:
    """It takes rows as position, normal, harmonics, opacity, scale and rotation, whatever the header says."""
    rows = PlyData.read(io.BytesIO(WRITERS["ply"](random_splats(5, degree), UNITS)))["vertex"].data
    rest = [f"f_rest_{index}" for index in range(3 * degree * (degree + 2))]
    layout = [*"xyz", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", *rest, "opacity"]
    layout += ["scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    assert list(rows.dtype.names or ()) == layout
    assert rows.dtype.itemsize == 4 * len(layout)
    assert degree != 3 or rows.dtype.itemsize == 248
    assert all((rows[name] == 0).all() for name in ("nx", "ny", "nz"))


def glb(data: bytes) -> tuple[dict[str, Any], bytes]:
    magic, version, total = struct.unpack_from("<4sII", data)
    assert (magic, version, total) == (b"glTF", 2, len(data))
    length = struct.unpack_from("<I", data, 12)[0]
    assert length % 4 == 0
    return json.loads(data[20 : 20 + length]), data[28 + length :]


def test_a_gltf_file_holds_every_value_as_an_attribute() -> None:
    splats = random_splats(7, 2)
    document, binary = glb(WRITERS["glb"](splats, UNITS))
    primitive = document["meshes"][0]["primitives"][0]
    assert primitive["mode"] == 0
    assert primitive["extensions"]["KHR_gaussian_splatting"]["kernel"] == "ellipse"
    assert len([name for name in primitive["attributes"] if "SH_DEGREE" in name]) == 9

    def values(name: str) -> np.ndarray:
        accessor = document["accessors"][primitive["attributes"][name]]
        view = document["bufferViews"][accessor["bufferView"]]
        assert accessor["count"] == 7
        return np.frombuffer(binary, "<f4", view["byteLength"] // 4, view["byteOffset"]).reshape(7, -1)

    scales = values("KHR_gaussian_splatting:SCALE")
    np.testing.assert_allclose(scales, splats.log_scales.exp().numpy() / UNITS.scale, rtol=1e-5)
    rotation = torch.nn.functional.normalize(splats.quats, dim=1)[:, 0].numpy()
    np.testing.assert_allclose(values("KHR_gaussian_splatting:ROTATION")[:, 3], rotation, rtol=1e-5)
    harmonics = values("KHR_gaussian_splatting:SH_DEGREE_2_COEF_1")
    np.testing.assert_array_equal(harmonics, splats.harmonics[:, 5].numpy())


@pytest.mark.parametrize("up", [(0.0, 0.0, 1.0), (0.0, -1.0, 0.0), (0.0, 1.0, 0.0), (0.6, 0.0, -0.8)])
def test_a_gltf_node_turns_the_captures_vertical_to_y(up: tuple[float, float, float]) -> None:
    document, _ = glb(WRITERS["glb"](random_splats(3, 0), replace(UNITS, up=up)))
    x, y, z, w = document["nodes"][0]["rotation"]
    axis, vector = np.array([x, y, z]), np.array(up)
    turned = vector + 2 * np.cross(axis, np.cross(axis, vector) + w * vector)
    np.testing.assert_allclose(turned, [0, 1, 0], atol=1e-6)


@pytest.mark.parametrize("format", [name for name in FORMATS if name not in ("zip", "splat")])
def test_every_format_is_written_from_a_model(format: str) -> None:
    exported = export_splats(tiny_model(), ExportRequest(format, time=0.5, degree=1))
    assert exported.splats > 20
    assert exported.degree == 1
    assert len(exported.data) > 500


def test_a_format_without_view_dependence_has_the_colours_of_a_fit_of_degree_0() -> None:
    model = tiny_model()
    exported = export_splats(model, ExportRequest("splat", time=0.5))
    assert exported.degree == 0
    cameras = [view.camera for view in model.views["train"]]
    plain = fit_splats(PreparedScene(model.scene), cameras, 0.5, degree=0).splats
    assert exported.data == WRITERS["splat"](plain, model.units)
    assert exported.data == export_splats(model, ExportRequest("splat", time=0.5, degree=0)).data


@pytest.mark.parametrize(
    ("units", "message"),
    [
        (Units((5000.0, 0.0, 0.0), 1.0), "coordinates below 2048, and here they reach 500"),
        (Units((0.0, 0.0, -2047.9), 1.0), "coordinates below 2048, and here they reach 2048"),
        (Units((0.0, 0.0, 0.0), 2.0**-12), "coordinates below 2048"),
        (Units((0.0, 0.0, 0.0), 2.0**-11), "splats up to a size of 379, and here they reach"),
        (
            Units((0.0, 0.0, 0.0), 2.0**9),
            "steps of 1/4096, and here half of the splats are smaller than 0.000",
        ),
        (Units((0.0, 0.0, 0.0), 2.0**16), "steps of 1/4096"),
    ],
)
def test_splats_that_an_spz_cannot_hold_are_refused(units: Units, message: str) -> None:
    splats = random_splats(200, 0)
    with pytest.raises(ValueError, match=rf"\.spz file holds .*{message}.*choose \.sog or \.ply"):
        WRITERS["spz"](splats, units)


@pytest.mark.parametrize("exponent", [-14, -10, 0, 6, 8, 12])
@pytest.mark.parametrize("format", KEEPS)
def test_a_format_is_right_or_refused_in_any_units(format: str, exponent: int, tmp_path: Path) -> None:
    splats, units = replace(random_splats(200, 0), sampling=None), Units((0.0, 0.0, 0.0), 2.0**exponent)
    file = tmp_path / f"a.{format}"
    try:
        file.write_bytes(WRITERS[format](splats, units))
    except ValueError:
        assert format == "spz"
        assert not -10 <= exponent <= 6
        return
    again, others = read_splats(file)
    for camera in ring(3):
        pose = others.camera(units.camera_back(camera))
        lens = (camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height)
        drawn = render(again, Camera(pose, *lens), 0.0, WHITE).color
        assert psnr(render(splats, camera, 0.0, WHITE).color, drawn) > KEEPS[format]


def test_a_sequence_has_a_manifest_and_a_file_for_each_time(tmp_path: Path) -> None:
    exported = export_splats(tiny_model(), ExportRequest("zip", frames=3))
    with zipfile.ZipFile(io.BytesIO(exported.data)) as archive:
        manifest = json.loads(archive.read("manifest.json"))
        assert manifest["schema"] == "graings.ply_sequence/1"
        assert [frame["t"] for frame in manifest["frames"]] == [0.0, 0.5, 1.0]
        assert [frame["capture_time"] for frame in manifest["frames"]] == [3.0, 4.0, 5.0]
        for frame in manifest["frames"]:
            (tmp_path / frame["file"]).write_bytes(archive.read(frame["file"]))
            splats, _ = read_splats(tmp_path / frame["file"])
            assert len(splats) == frame["splats"]
            assert splats.degree == manifest["degree"]


def test_a_selection_drops_what_lies_outside_or_is_not_seen(tmp_path: Path) -> None:
    model = tiny_model()
    whole = export_splats(model, ExportRequest("ply"))
    low, high = np.array(UNITS.center) - 1, np.array(UNITS.center) + 1
    for selection in (Selection(box=(*low, *high)), Selection(sphere=(*UNITS.center, 1.0))):
        part = export_splats(model, ExportRequest("ply", selection=selection))
        assert part.splats + part.dropped == whole.splats
        assert 0 < part.splats < whole.splats
        rows = PlyData.read(io.BytesIO(part.data))["vertex"].data
        positions = np.stack([rows[name] for name in "xyz"], 1) - np.array(UNITS.center)
        sizes = np.linalg.norm(positions, axis=1) if selection.sphere else np.abs(positions)
        assert sizes.max() <= 1 + 1e-5
    view = model.views["train"][0]
    camera = view.camera
    detail = Camera(camera.world_to_camera, 8 * camera.fx, 8 * camera.fy, camera.cx, camera.cy, *SIZE)
    one_view = replace(model, views={"train": (replace(view, camera=detail),)})
    assert export_splats(one_view, ExportRequest("ply", selection=Selection(seen=True))).dropped > 0
    with pytest.raises(ValueError, match="is left"):
        export_splats(model, ExportRequest("ply", selection=Selection(sphere=(100.0, 0.0, 0.0, 1.0))))


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (lambda: Selection(box=(0, 0, 0, 1, -1, 1)), "lower corner"),
        (lambda: Selection(box=(0, 0, 0, 1, math.nan, 1)), "finite"),
        (lambda: Selection(sphere=(0, 0, 0, 0)), "radius above 0"),
        (lambda: ExportRequest("obj"), "choose one of ply"),
        (lambda: ExportRequest("ply", time=1.5), "time"),
        (lambda: ExportRequest("ply", time=math.nan), "time"),
        (lambda: ExportRequest("zip", frames=0), "frames"),
        (lambda: ExportRequest("ply", degree=4), "degree"),
        (lambda: ExportRequest("splat", degree=1), r"degree must be 0 for a \.splat file"),
        (lambda: export_format(Path("a.obj")), r"\.ply, .*\.spz"),
        (lambda: export_format(Path("ply")), r"choose one of"),
    ],
)
def test_a_wrong_request_is_refused(wrong: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        wrong()


@pytest.mark.parametrize("format", [*FORMATS, *WHOLE])
def test_what_a_format_does_not_use_is_refused_with_both_names(format: str) -> None:
    used = {"frames", "degree"} if format in SEVERAL else set() if format in WHOLE else {"time", "degree"}
    words = {"time": "a time", "frames": "a number of frames", "degree": "a degree"}
    for name, value in (("time", 0.0), ("frames", 30), ("degree", 0)):
        if name in used:
            check_used(format, **{name: value})  # type: ignore[arg-type]
        else:
            with pytest.raises(ValueError, match=rf"^{words[name]} is not used by a \.{format} file"):
                check_used(format, **{name: value})  # type: ignore[arg-type]
    check_used(format)


def test_a_suffix_of_two_parts_wins() -> None:
    assert export_format(Path("a.compressed.ply")) == "compressed.ply"
    assert export_format(Path("A.PLY")) == "ply"
    assert export_format(Path("a.graings")) == "graings"


def broken_files() -> dict[str, tuple[str, bytes, str]]:
    good = WRITERS["ply"](random_splats(4, 1), UNITS)
    points = (
        b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
    )
    return {
        "empty": ("a.ply", b"", "no PLY file of splats"),
        "truncated": ("a.ply", good[:-9], "no PLY file of splats"),
        "far too many declared": (
            "a.ply",
            good.replace(b"vertex 4", b"vertex 99999999999999"),
            "no PLY file of splats",
        ),
        "points": ("a.ply", points + b"1 2 3\n", "has no f_dc_0"),
        "odd harmonics": ("a.ply", good.replace(b"f_rest_8", b"g_rest_8"), "8 columns f_rest"),
        "none": (
            "a.ply",
            good.split(b"element")[0] + good[good.index(b"element") :].replace(b" 4\n", b" 0\n"),
            "no splats",
        ),
        "no spz": ("a.spz", b"nothing", "(cannot be converted|no PLY file)"),
        "another kind": ("a.obj", good, "no file of splats"),
    }


@pytest.mark.parametrize("name", broken_files())
def test_a_broken_file_is_refused_with_its_name_and_a_remedy(name: str, tmp_path: Path) -> None:
    file, data, message = broken_files()[name]
    (tmp_path / file).write_bytes(data)
    with pytest.raises(CheckpointError, match=rf"{file}: .*{message}.*\. \w"):
        read_splats(tmp_path / file)


def test_others_splats_are_shown_from_an_orbit_about_their_vertical(tmp_path: Path) -> None:
    (tmp_path / "a.ply").write_bytes(WRITERS["ply"](random_splats(50, 0), UNITS))
    shown = open_shown(tmp_path / "a.ply", (0.0, 0.0, 2.0))
    assert shown.units.up == (0.0, 0.0, 1.0)
    camera = shown.views["train"][0].camera
    assert camera.center[2] > 0
    assert float(render(shown.scene, camera, 0.0, (0.0, 0.0, 0.0)).alpha.max()) > 0.5
    with pytest.raises(ValueError, match="up"):
        open_shown(tmp_path / "a.ply", (0.0, 0.0, 0.0))


def test_formats_that_are_read_are_written_or_named() -> None:
    assert set(READABLE) - set(WRITERS) == {"ksplat"}
