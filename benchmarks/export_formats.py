"""Export table: bytes and quality of every format of splats, read back by others and drawn by gsplat's torch reference.

    pip install -e .[bench,splats]; npm install @playcanvas/splat-transform gltf-validator
    python benchmarks/export_formats.py RUN [--time 0.3] [--views 3] [--node-modules DIR]
    python benchmarks/export_formats.py --ply FILE [--views 3]

For RUN each format is written, read by splat-transform of PlayCanvas (.glb: by this script; it is also given to the
validator of Khronos) and drawn by gsplat's functions at test views. PSNR against our own image of the model: `own blur`
with the low-pass filter of the model, which leaves fit and quantisation; `0.3 px` with that of viewers. For a FILE of
others' splats: PSNR of `graings render` against gsplat, at views around it.
"""

from __future__ import annotations

import argparse
import json
import math
import struct
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gsplat_reference import PUBLIC, Projection, Rules, blended, load_gsplat, quick_tile_lists
from plyfile import PlyData
from torch import Tensor

from graings.camera.camera import Camera
from graings.camera.units import Units
from graings.camera.view_request import ViewRequest
from graings.export.export import ExportRequest, export_splats
from graings.export.formats import WRITERS
from graings.export.harmonics_fit import fit_splats
from graings.export.shown import open_shown
from graings.render import PreparedScene, low_pass, render
from graings.storage.compact import open_model

VALIDATE = """
const validator = require('gltf-validator'), fs = require('fs');
const bytes = new Uint8Array(fs.readFileSync(process.argv[1]));
validator.validateBytes(bytes).then(report => console.log(JSON.stringify(report.issues)));
"""


class Outside:
    """gsplat's projection, harmonics and blending, in capture units."""

    def __init__(self) -> None:
        self.gsplat = load_gsplat()

    @torch.no_grad()
    def draw(self, rows: dict[str, Tensor], camera: Camera, background: tuple[float, ...], blur: float) -> Tensor:
        """The image of standard 3DGS columns by a camera in the same units."""
        means, shape = rows["means"], rows["harmonics"]
        directions = torch.nn.functional.normalize(means - torch.from_numpy(np.array(camera.center)), dim=-1)
        degree = math.isqrt(shape.shape[1]) - 1
        colors = (self.gsplat._spherical_harmonics(degree, directions, shape) + 0.5).clamp_min(0)
        covariances, _ = self.gsplat._quat_scale_to_covar_preci(rows["quats"], rows["scales"], compute_preci=False)
        pose = torch.from_numpy(np.array(camera.world_to_camera))[None]
        lens = torch.tensor([[[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]]], dtype=torch.float64)
        radii, means2d, depths, conics, _ = self.gsplat._fully_fused_projection(
            *(means, covariances, pose, lens, camera.width, camera.height), eps2d=blur, near_plane=PUBLIC.near
        )
        projection = Projection(means2d[0], conics[0], depths[0], radii[0])
        lists = quick_tile_lists(projection, camera, Rules())
        entries = blended(projection, rows["opacities"], lists, camera, Rules())
        color, alpha = self.gsplat.accumulate(
            *(means2d, conics, rows["opacities"][None], colors[None], entries.gaussians, entries.pixels),
            *(torch.zeros_like(entries.pixels), camera.width, camera.height),
        )
        return color[0] + torch.tensor(background, dtype=torch.float64) * (1 - alpha[0])


def ply_rows(path: Path) -> dict[str, Tensor]:
    """Columns of a 3DGS PLY as the formulas take them, float64."""
    table = PlyData.read(str(path))["vertex"].data

    def columns(*names: str) -> Tensor:
        return torch.from_numpy(np.stack([table[name].astype(np.float64) for name in names], 1))

    rest = [name for name in table.dtype.names if name.startswith("f_rest_")]
    harmonics = columns("f_dc_0", "f_dc_1", "f_dc_2")[:, None]
    if rest:
        more = columns(*(f"f_rest_{index}" for index in range(len(rest)))).unflatten(1, (3, -1)).transpose(1, 2)
        harmonics = torch.cat([harmonics, more], 1)
    return {
        "means": columns("x", "y", "z"),
        "quats": torch.nn.functional.normalize(columns("rot_0", "rot_1", "rot_2", "rot_3"), dim=-1),
        "scales": columns("scale_0", "scale_1", "scale_2").exp(),
        "opacities": columns("opacity").sigmoid()[:, 0],
        "harmonics": harmonics,
    }


def glb_rows(data: bytes) -> dict[str, Tensor]:
    """The same of a binary glTF file."""
    length = struct.unpack_from("<I", data, 12)[0]
    document, binary = json.loads(data[20 : 20 + length]), data[28 + length :]

    def values(index: int) -> Tensor:
        accessor = document["accessors"][index]
        view = document["bufferViews"][accessor["bufferView"]]
        flat = np.frombuffer(binary, "<f4", view["byteLength"] // 4, view["byteOffset"])
        return torch.from_numpy(flat.reshape(accessor["count"], -1).astype(np.float64))

    found = {n.split(":")[-1]: values(i) for n, i in document["meshes"][0]["primitives"][0]["attributes"].items()}
    harmonics = [found[name] for name in found if name.startswith("SH_DEGREE")]
    quats = found["ROTATION"][:, [3, 0, 1, 2]]
    rows = {"means": found["POSITION"], "quats": quats, "scales": found["SCALE"], "opacities": found["OPACITY"][:, 0]}
    return rows | {"harmonics": torch.stack(harmonics, 1)}


def psnr(a: Tensor, b: Tensor) -> float:
    return -10 * math.log10(float((a.double().clamp(0, 1) - b.double().clamp(0, 1)).square().mean()))


def in_capture_units(camera: Camera, units: Units) -> Camera:
    lens = (camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height)
    return Camera(units.camera_back(camera), *lens)


def formats(options: argparse.Namespace, folder: Path) -> list[dict[str, Any]]:
    model, outside = open_model(options.run), Outside()
    scene = PreparedScene(model.scene)
    views = model.views["test"]
    cameras = [views[index * len(views) // options.views].camera for index in range(options.views)]
    truth = [render(scene, camera, options.time, model.background).color for camera in cameras]
    fit = fit_splats(scene, [view.camera for view in model.views["train"]], options.time).splats
    fitted = [render(fit, camera, options.time, model.background).color for camera in cameras]
    quality = sum(map(psnr, truth, fitted)) / len(cameras)
    rows = [{"format": "(fit, ours)", "bytes": "", "own blur": f"{quality:.1f}", "0.3 px": "", "validator": ""}]
    for name in options.formats:
        file, back = folder / f"scene.{name}", folder / f"{name}.back.ply"
        file.write_bytes(export_splats(model, ExportRequest(name, time=options.time)).data)
        verdict = ""
        if name == "glb":
            splats = glb_rows(file.read_bytes())
            command = ["node", "-e", VALIDATE, str(file)]
            issues = json.loads(subprocess.check_output(command, cwd=options.node_modules.parent))
            # The validator does not know the extension yet, so it calls the names of its attributes invalid.
            unknown = [m for m in issues["messages"] if m["code"] == "MESH_PRIMITIVE_INVALID_ATTRIBUTE"]
            unknown = [m for m in unknown if "/KHR_gaussian_splatting:" in m["pointer"]]
            verdict = (
                f"{len(unknown)} names of the extension unknown; else {issues['numErrors'] - len(unknown)} errors, "
            )
            verdict += f"{issues['numWarnings']} warnings"
        else:
            tool = options.node_modules / "@playcanvas/splat-transform/bin/cli.mjs"
            subprocess.run(["node", str(tool), "-q", "-w", str(file), str(back)], check=True, capture_output=True)
            splats, verdict = ply_rows(back), "read by splat-transform"
        found: dict[str, list[float]] = {"own blur": [], "0.3 px": []}
        for camera, image in zip(cameras, truth, strict=True):
            for label, blur in (("own blur", low_pass(scene.compose(camera.center, 0.0), camera)), ("0.3 px", 0.3)):
                drawn = outside.draw(splats, in_capture_units(camera, model.units), model.background, blur)
                found[label].append(psnr(image, drawn))
        means = {label: f"{sum(values) / len(values):.1f}" for label, values in found.items()}
        rows.append({"format": name, "bytes": file.stat().st_size, **means, "validator": verdict})
        print(rows[-1], flush=True)
    return rows


def others(options: argparse.Namespace) -> list[dict[str, Any]]:
    file, outside = open_shown(options.ply), Outside()
    splats, rows = ply_rows(options.ply), []
    for index in range(options.views):
        request = ViewRequest(azimuth=360.0 * index / options.views, elevation=10.0, width=options.size)
        camera, _, _ = request.resolve(file.views, file.units, (1.0, 1.0, 1.0))
        ours = render(file.scene, camera, 0.0, (1.0, 1.0, 1.0)).color
        theirs = outside.draw(splats, in_capture_units(camera, file.units), (1.0, 1.0, 1.0), 0.3)
        rows.append({"view": index, "size": f"{camera.width} x {camera.height}", "PSNR": f"{psnr(ours, theirs):.1f}"})
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, nargs="?")
    parser.add_argument("--ply", type=Path)
    parser.add_argument("--time", type=float, default=0.3)
    parser.add_argument("--formats", nargs="+", choices=list(WRITERS), default=list(WRITERS))
    parser.add_argument("--views", type=int, default=3)
    parser.add_argument("--size", type=int, default=400, help="px, for --ply")
    parser.add_argument("--node-modules", type=Path, default=Path("node_modules"))
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        rows = formats(options, Path(folder)) if options.run else others(options)
    print(" | ".join(rows[0]))
    for row in rows:
        print(" | ".join(map(str, row.values())))


if __name__ == "__main__":
    main()
