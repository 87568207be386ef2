"""Compares the rasterizer with the plain PyTorch reference that ships inside the package `gsplat`.

    pip install -e .[bench]
    python benchmarks/gsplat_reference.py --yardstick DIR [--gaussians 1000 10000] [--size 200 400]
                                          [--views whole close] [--threads N] [--rounds 3] [--json FILE]

DIR holds `bench_scene.py` with `make_scene(n)`, `camera(size, dist=...)` and `target_image(height, width)`.

Only the file `gsplat/cuda/_torch_impl.py` is loaded, by its path: the package itself would look for a CUDA compiler
when imported, and this file needs nothing but torch (the extra `bench` pins the version of gsplat whose rules are
implemented here; `pip install --no-deps` of that version is enough). Projection, covariances, footprint, tile lists
and `accumulate`, the blending, are the package's. Two CUDA functions that it uses are replaced by our own
torch code: `rasterize_to_indices_in_range`, which decides which Gaussians a pixel blends (by the rules of that kernel:
alpha below 1/255 is skipped, and the Gaussian that would reduce the transmittance to 1e-4 or less ends the pixel and is
not blended), and the two functions of `nerfacc` that `accumulate` calls.

Views: `whole` is the scene from outside; `close` is inside it, off-centre and not square, with opacities of one, so
that near plane, clamp of the Jacobian, culling and alpha cap all have an effect.

Prints, for each scene: the differences of the projection; of the image under pairs of rules (the same rules on both
sides must agree to rounding, and a pair that differs by one rule shows what that rule does); the cause of each pixel
that differs by more than 1e-4; the gradients; and, for `whole`, the times of forward + backward, measured alternately.
"""

from __future__ import annotations

import argparse
import importlib
import importlib.metadata
import importlib.util
import json
import statistics
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import torch
from torch import Tensor

from graings import kernel
from graings.camera.camera import Camera
from graings.constants import TILE
from graings.gaussians import Gaussians
from graings.kernel import use_threads
from graings.raster.rasterize import rasterize
from graings.raster.result import DEFAULT_SETTINGS, RasterSettings

# Constants of gsplat that are not parameters.
GSPLAT_ALPHA_MIN = 1 / 255
GSPLAT_ALPHA_MAX = 0.999
GSPLAT_STOP = 1e-4
GSPLAT_FAR = 1e10

VISIBLE = 1e-4  # differences of a pixel above this are counted and explained
NEAR_MISS = 1e-4  # relative distance to a threshold within which rounding in float32 may decide
RAYS_AT_ONCE = 2048  # rays are padded to the longest of this many: bounds the memory, keeps torch's calls few

# Ours, drawn with as many of gsplat's rules as there are settings for.
PUBLIC = RasterSettings(alpha_max=GSPLAT_ALPHA_MAX, far=GSPLAT_FAR, compat=True)
OURS_SAME_CAP = replace(PUBLIC, compat=False)

LEAVES = ("means", "quats", "log_scales", "opacities", "colors")


@dataclass(frozen=True, slots=True)
class Rules:
    """The rules in which the two differ; the defaults are those of gsplat."""

    square: bool = False  # footprint: a square of three deviations of the longer axis, not a box of 3.33 for each axis
    inclusive: bool = False  # stop: the Gaussian that crosses the threshold is blended
    exact_order: bool = False  # sort by the exact depth, not by its float32 bits


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """Gaussians in float64 (with values that float32 represents exactly), a camera and an upstream gradient."""

    name: str
    leaves: Mapping[str, Tensor]
    camera: Camera
    background: Tensor
    upstream: Tensor  # [height, width, 5]: of colour, alpha and depth

    def inputs(self, dtype: torch.dtype) -> dict[str, Tensor]:
        """Fresh leaves of autograd."""
        return {name: self.leaves[name].to(dtype).requires_grad_() for name in LEAVES}


@dataclass(frozen=True, slots=True, eq=False)
class Projection:
    """Output of the reference's projection, one row for each Gaussian."""

    means2d: Tensor
    conics: Tensor
    depths: Tensor
    radii: Tensor


@dataclass(frozen=True, slots=True, eq=False)
class Entries:
    """Which Gaussian is blended into which pixel, front to back within a pixel."""

    gaussians: Tensor
    pixels: Tensor


@dataclass(frozen=True, slots=True, eq=False)
class Drawn:
    """An image [height, width, 5] (colour, alpha, depth) and the leaves of the graph."""

    image: Tensor
    leaves: dict[str, Tensor]
    means2d: Tensor  # the tensor whose gradient is the one in screen space

    def gradients(self, upstream: Tensor) -> dict[str, Tensor]:
        names = [*self.leaves, "means2d"]
        ends = [*self.leaves.values(), self.means2d]
        found = torch.autograd.grad(self.image, ends, upstream.to(self.image.dtype), retain_graph=True)
        return {name: gradient.reshape(len(gradient), -1).double() for name, gradient in zip(names, found, strict=True)}


# --- the package ------------------------------------------------------------------------------------------------------


def load_gsplat() -> ModuleType:
    """The reference's module, without the package around it."""
    package = importlib.util.find_spec("gsplat")
    if package is None or not package.submodule_search_locations:
        sys.exit("gsplat is not installed: pip install -e .[bench]")
    path = Path(package.submodule_search_locations[0]) / "cuda" / "_torch_impl.py"
    spec = importlib.util.spec_from_file_location("gsplat_torch_impl", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    stand_in: Any = ModuleType("nerfacc")  # `accumulate` imports it when called; the real package needs CUDA
    stand_in.render_weight_from_alpha = weights_along_rays
    stand_in.accumulate_along_rays = sums_along_rays
    sys.modules["nerfacc"] = stand_in
    return module


def weights_along_rays(alphas: Tensor, *, ray_indices: Tensor, n_rays: int) -> tuple[Tensor, Tensor]:
    """Weight and incoming light of each sample; samples of one ray are neighbours, front to back."""
    del n_rays  # part of the signature
    _, counts = torch.unique_consecutive(ray_indices, return_counts=True)
    begins = counts.cumsum(0) - counts
    parts = []
    for some, begin in zip(counts.split(RAYS_AT_ONCE), begins.split(RAYS_AT_ONCE), strict=True):
        start, end = int(begin[0]), int(begin[-1] + some[-1])
        row = torch.repeat_interleave(torch.arange(len(some)), some)
        column = torch.arange(start, end) - begin[row]
        padded = alphas.new_zeros(len(some), int(some.max()) + 1).index_put((row, column + 1), alphas[start:end])
        parts.append((1 - padded).cumprod(1)[row, column])
    light = torch.cat(parts) if parts else torch.ones_like(alphas)
    return alphas * light, light


def sums_along_rays(weights: Tensor, values: Tensor | None, *, ray_indices: Tensor, n_rays: int) -> Tensor:
    """Weighted sums [rays, channels]; without values the sums of the weights."""
    weighted = weights[:, None] if values is None else weights[:, None] * values
    return weighted.new_zeros(n_rays, weighted.shape[1]).index_add(0, ray_indices, weighted)


class Reference:
    """A rasterizer composed of gsplat's torch functions."""

    def __init__(self, gsplat: ModuleType) -> None:
        self.gsplat: Any = gsplat

    def project(self, leaves: Mapping[str, Tensor], camera: Camera) -> Projection:
        dtype = leaves["means"].dtype
        covariances, _ = self.gsplat._quat_scale_to_covar_preci(
            leaves["quats"], leaves["log_scales"].exp(), compute_preci=False
        )
        radii, means2d, depths, conics, _ = self.gsplat._fully_fused_projection(
            leaves["means"],
            covariances,
            _pose(camera).to(dtype)[None],
            _intrinsics(camera).to(dtype)[None],
            camera.width,
            camera.height,
            eps2d=PUBLIC.blur,
            near_plane=PUBLIC.near,
            far_plane=GSPLAT_FAR,
        )
        return Projection(means2d[0], conics[0], depths[0], radii[0])

    @torch.no_grad()
    def square_radii(self, scene: Scene, projection: Projection) -> Tensor:
        """Radii by the rule of older public rasterizers: three deviations of the longer axis, rounded up, on both."""
        camera, leaves = scene.camera, scene.leaves
        world, _ = self.gsplat._quat_scale_to_covar_preci(
            leaves["quats"], leaves["log_scales"].exp(), compute_preci=False
        )
        seen = self.gsplat._world_to_cam(leaves["means"], world, _pose(camera)[None])
        _, flat = self.gsplat._persp_proj(*seen, _intrinsics(camera)[None], camera.width, camera.height)
        a, b, c = flat[0, :, 0, 0] + PUBLIC.blur, flat[0, :, 0, 1], flat[0, :, 1, 1] + PUBLIC.blur
        longest = (0.5 * (a + c) + torch.hypot(0.5 * (a - c), b)).sqrt()
        ahead = (projection.depths > PUBLIC.near) & (projection.depths < GSPLAT_FAR)
        return torch.where(ahead, (3 * longest).ceil(), 0.0)[:, None].expand(-1, 2)

    @torch.no_grad()
    def tile_lists(self, projection: Projection, camera: Camera) -> list[Tensor]:
        """The package's own lists: a loop in Python over Gaussians and tiles."""
        across, down = _tiles(camera)
        flat = [t[None] for t in (projection.means2d, projection.radii, projection.depths)]
        _, keys, ids = self.gsplat._isect_tiles(*flat, TILE, across, down)
        begins = self.gsplat._isect_offset_encode(keys, 1, across, down).flatten().long()
        return list(ids.long().tensor_split(begins[1:]))

    def accumulate(
        self, projection: Projection, leaves: Mapping[str, Tensor], entries: Entries, scene: Scene
    ) -> Tensor:
        """Colour, alpha and depth [height, width, 5]; depth is a fourth channel to the package."""
        camera, dtype = scene.camera, leaves["means"].dtype
        looks = torch.cat([leaves["colors"], projection.depths[:, None]], 1)
        color, alpha = self.gsplat.accumulate(
            projection.means2d[None],
            projection.conics[None],
            leaves["opacities"][None],
            looks[None],
            entries.gaussians,
            entries.pixels,
            torch.zeros_like(entries.pixels),
            camera.width,
            camera.height,
        )
        ground = scene.background.to(dtype) * (1 - alpha[0])
        return torch.cat([color[0, ..., :3] + ground, alpha[0], color[0, ..., 3:]], -1)

    def draw(
        self,
        scene: Scene,
        dtype: torch.dtype,
        rules: Rules,
        *,
        shipped_lists: bool = False,
        decided: Entries | None = None,
    ) -> Drawn:
        """One forward pass; `decided` replaces the pixels' own decisions."""
        leaves = scene.inputs(dtype)
        projection = self.project(leaves, scene.camera)
        if decided is None:
            decided = self.entries(scene, leaves, projection, rules, shipped_lists=shipped_lists)
        return Drawn(self.accumulate(projection, leaves, decided, scene), leaves, projection.means2d)

    @torch.no_grad()
    def entries(
        self,
        scene: Scene,
        leaves: Mapping[str, Tensor],
        projection: Projection,
        rules: Rules,
        *,
        shipped_lists: bool = False,
    ) -> Entries:
        if shipped_lists:
            lists = self.tile_lists(projection, scene.camera)
        else:
            radii = self.square_radii(scene, projection) if rules.square else projection.radii
            lists = quick_tile_lists(replace(projection, radii=radii), scene.camera, rules)
        return blended(projection, leaves["opacities"], lists, scene.camera, rules)


def _pose(camera: Camera) -> Tensor:
    return torch.from_numpy(np.array(camera.world_to_camera))


def _intrinsics(camera: Camera) -> Tensor:
    rows = [[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]]
    return torch.tensor(rows, dtype=torch.float64)


def _tiles(camera: Camera) -> tuple[int, int]:
    return -(-camera.width // TILE), -(-camera.height // TILE)


# --- what a pixel blends ----------------------------------------------------------------------------------------------


@torch.no_grad()
def quick_tile_lists(projection: Projection, camera: Camera, rules: Rules) -> list[Tensor]:
    """The lists of `Reference.tile_lists` without the loop in Python."""
    across, down = _tiles(camera)
    most = torch.tensor([across, down])
    depths = projection.depths if rules.exact_order else projection.depths.float()
    order = torch.argsort(depths, stable=True)
    order = order[(projection.radii[order] > 0).all(1)]
    means2d, radii = projection.means2d[order], projection.radii[order]
    first = ((means2d - radii) / TILE).floor().long().clamp(min=torch.zeros(2, dtype=torch.long), max=most)
    last = ((means2d + radii) / TILE).ceil().long().clamp(min=torch.zeros(2, dtype=torch.long), max=most)
    spans = (last - first).clamp(min=0)
    counts = spans.prod(1)
    row = torch.repeat_interleave(torch.arange(len(order)), counts)
    nth = torch.arange(len(row)) - (counts.cumsum(0) - counts)[row]
    tile = (first[row, 1] + nth // spans[row, 0]) * across + first[row, 0] + nth % spans[row, 0]
    by_tile = torch.argsort(tile, stable=True)
    sizes: list[int] = torch.bincount(tile, minlength=across * down).tolist()
    return list(order[row[by_tile]].split(sizes))


def raw_alphas(projection: Projection, opacities: Tensor, ids: Tensor, pixels: Tensor, width: int) -> Tensor:
    """Alpha before cap and cut [pixel, entry]; zero where rounding makes the exponent negative, as gsplat skips it."""
    centres = torch.stack([pixels % width, pixels // width], 1) + 0.5
    x, y = (centres[:, None, :] - projection.means2d[ids]).unbind(2)
    a, b, c = projection.conics[ids].unbind(1)
    exponent = 0.5 * (a * x**2 + c * y**2) + b * x * y
    return torch.where(exponent >= 0, opacities[ids] * torch.exp(-exponent), 0.0)


@torch.no_grad()
def blended(
    projection: Projection, opacities: Tensor, lists: Sequence[Tensor], camera: Camera, rules: Rules
) -> Entries:
    """Front to back in each pixel: skip alphas below the minimum, stop at the minimum transmittance."""
    across, _ = _tiles(camera)
    gaussians, pixels = [], []
    for tile, ids in enumerate(lists):
        if len(ids) == 0:
            continue
        inside = tile_pixels(tile, across, camera)
        raw = raw_alphas(projection, opacities, ids, inside, camera.width)
        counts = raw >= GSPLAT_ALPHA_MIN
        after = (1 - torch.where(counts, raw.clamp(max=GSPLAT_ALPHA_MAX), 0.0)).cumprod(1)
        if rules.inclusive:
            before = torch.cat([torch.ones_like(after[:, :1]), after[:, :-1]], 1)
            counts &= before >= GSPLAT_STOP
        else:
            counts &= after > GSPLAT_STOP
        row, column = counts.nonzero().unbind(1)
        gaussians.append(ids[column])
        pixels.append(inside[row])
    nothing = torch.zeros(0, dtype=torch.long)
    return Entries(torch.cat([nothing, *gaussians]), torch.cat([nothing, *pixels]))


def tile_pixels(tile: int, across: int, camera: Camera) -> Tensor:
    """Row-major numbers of the image's pixels in a tile."""
    left, top = tile % across * TILE, tile // across * TILE
    columns = torch.arange(left, min(left + TILE, camera.width))
    rows = torch.arange(top, min(top + TILE, camera.height))
    return (rows[:, None] * camera.width + columns).flatten()


def near_misses(reference: Reference, scene: Scene, rules: Rules, chosen: Tensor) -> dict[str, int]:
    """How many of the chosen pixels come, in float64, so close to a threshold that float32 may decide differently."""
    leaves = scene.inputs(torch.float64)
    with torch.no_grad():
        projection = reference.project(leaves, scene.camera)
        radii = reference.square_radii(scene, projection) if rules.square else projection.radii
        lists = quick_tile_lists(replace(projection, radii=radii), scene.camera, rules)
    across, _ = _tiles(scene.camera)
    found = {"cut": 0, "stop": 0, "tie": 0, "none": 0}
    for pixel in chosen.tolist():
        tile = pixel // scene.camera.width // TILE * across + pixel % scene.camera.width // TILE
        reasons = _reasons(projection, leaves["opacities"].detach(), lists[tile], pixel, scene.camera.width)
        for reason in reasons or {"none"}:
            found[reason] += 1
    return found


def _reasons(projection: Projection, opacities: Tensor, ids: Tensor, pixel: int, width: int) -> set[str]:
    raw = raw_alphas(projection, opacities, ids, torch.tensor([pixel]), width)[0]
    counts = raw >= GSPLAT_ALPHA_MIN
    after = (1 - torch.where(counts, raw.clamp(max=GSPLAT_ALPHA_MAX), 0.0)).cumprod(0)
    lit = torch.cat([after.new_ones(1), after[:-1]]) > 0.5 * GSPLAT_STOP
    depths = projection.depths[ids[counts & lit]]
    gaps = depths.diff() / depths[1:]
    reasons = {
        "cut": ((raw / GSPLAT_ALPHA_MIN - 1).abs() < NEAR_MISS) & lit,
        "stop": (after / GSPLAT_STOP - 1).abs() < NEAR_MISS,
        "tie": gaps < 4 * torch.finfo(torch.float32).eps,
    }
    return {name for name, hit in reasons.items() if bool(hit.any())}


# --- ours -------------------------------------------------------------------------------------------------------------


def draw_ours(scene: Scene, dtype: torch.dtype, settings: RasterSettings) -> Drawn:
    leaves = scene.inputs(dtype)
    offset = torch.zeros(len(leaves["means"]), 2, dtype=dtype, requires_grad=True)
    gaussians = Gaussians(**leaves, uids=torch.arange(len(offset)))
    result = rasterize(gaussians, scene.camera, scene.background.to(dtype), means2d_offset=offset, settings=settings)
    image = torch.cat([result.color, result.alpha[..., None], result.depth[..., None]], -1)
    return Drawn(image, leaves, offset)


# --- scenes -----------------------------------------------------------------------------------------------------------


def load_scenes(folder: Path) -> ModuleType:
    if not (folder / "bench_scene.py").is_file():
        sys.exit(f"{folder / 'bench_scene.py'} not found: give its folder with --yardstick")
    sys.path.insert(0, str(folder))
    return importlib.import_module("bench_scene")


def make_scene(scenes: ModuleType, count: int, size: int, view: str, *, rigid: bool = True) -> Scene:
    """`rigid` turns the pose, which comes in float32, to the nearest true rotation."""
    raw = scenes.make_scene(count)
    leaves = {name: torch.from_numpy(raw[name]) for name in ("means", "quats", "opacities", "colors")}
    leaves["log_scales"] = torch.from_numpy(raw["scales"]).log()
    leaves = {name: leaf.double() for name, leaf in leaves.items()}
    seen = scenes.camera(size) if view == "whole" else scenes.camera(size, dist=1.0)
    width, height, cx, fy = size, size, seen["cx"], seen["fy"]
    if view == "close":
        height, cx, fy = 3 * size // 4, 0.4 * size, 1.1 * fy
        leaves["opacities"] = torch.where(leaves["opacities"] > 0.9, 1.0, leaves["opacities"])
    pose = seen["viewmat"].astype(np.float64)
    if rigid:
        left, _, right = np.linalg.svd(pose[:3, :3])
        pose[:3, :3] = left @ right
    camera = Camera(pose, seen["fx"], fy, cx, 0.5 * height, width, height)
    target = torch.from_numpy(scenes.target_image(height, width)).double() - 0.5
    upstream = torch.cat([target, target[..., 1:]], -1)  # alpha and depth get a share as well
    background = torch.tensor([0.2, 0.4, 0.6], dtype=torch.float64)
    return Scene(f"{count}/{size} {view}", leaves, camera, background, upstream)


# --- comparisons ------------------------------------------------------------------------------------------------------

Row = dict[str, Any]


def show(title: str, rows: Sequence[Row]) -> None:
    """A table with the keys of the first row as its head."""
    print(f"\n{title}")
    if not rows:
        return
    cells = [[_cell(value) for value in row.values()] for row in rows]
    widths = [max(len(text) for text in column) for column in zip(list(rows[0]), *cells, strict=True)]
    for first, *rest in [list(rows[0]), *cells]:
        columns = [first.ljust(widths[0]), *(text.rjust(w) for text, w in zip(rest, widths[1:], strict=True))]
        print("  " + "  ".join(columns), flush=True)


def _cell(value: object) -> str:
    return f"{value:.2e}" if isinstance(value, float) else str(value)


def projection_rows(reference: Reference, scene: Scene) -> list[Row]:
    """Largest differences of what both project; ours has no list of depths, so its formula R (x - centre) stands in."""
    rows = []
    for dtype in (torch.float32, torch.float64):
        leaves = scene.inputs(dtype)
        with torch.no_grad():
            theirs = reference.project(leaves, scene.camera)
            square = reference.square_radii(scene, theirs)
            gaussians = Gaussians(**leaves, uids=torch.arange(len(theirs.depths)))
            ours = rasterize(gaussians, scene.camera, scene.background.to(dtype), settings=PUBLIC)
            pose, centre = _pose(scene.camera), torch.from_numpy(scene.camera.center.copy())
            depths = (leaves["means"].double() - centre) @ pose[2, :3]
            lists = quick_tile_lists(replace(theirs, radii=square), scene.camera, Rules(square=True))
            listed = torch.zeros(len(depths), dtype=torch.bool).index_fill(0, torch.cat(lists), True)
        drawn, both = (ours.radii > 0).all(1), (ours.radii > 0).all(1) & (theirs.radii > 0).all(1)
        rows.append(
            {
                "dtype": _name(dtype),
                "drawn by both": int(both.sum()),
                "ours only": int((drawn & ~both).sum()),
                "gsplat only": int(((theirs.radii > 0).all(1) & ~drawn).sum()),
                "3-sigma rule: differ": int((drawn != listed).sum()),
                "means2d max px": _largest((ours.means2d - theirs.means2d)[both]),
                "relative": _largest(((ours.means2d - theirs.means2d) / theirs.means2d.abs().clamp(min=1))[both]),
                "depths max": _largest((depths - theirs.depths)[both]),
                "radii: differ": int((ours.radii != square)[drawn].any(1).sum()),
            }
        )
    return rows


def _name(dtype: torch.dtype) -> str:
    return str(dtype).removeprefix("torch.")


def _largest(tensor: Tensor) -> float:
    return float(tensor.abs().max()) if tensor.numel() else 0.0


def difference(label: str, a: Tensor, b: Tensor) -> Row:
    """Statistics over pixels of the largest difference among the three colours, and of alpha and depth."""
    apart = (a.detach().double() - b.detach().double()).abs()
    color = apart[..., :3].amax(-1).flatten()
    return {
        "pair": label,
        "colour max": float(color.max()),
        "mean": float(color.mean()),
        "99.9 %": float(color.kthvalue(max(1, round(0.999 * len(color)))).values),
        "pixels > 1e-4": int((color > VISIBLE).sum()),
        "alpha max": _largest(apart[..., 3]),
        "depth max": _largest(apart[..., 4]),
    }


RULE_PAIRS: tuple[tuple[str, RasterSettings, Rules], ...] = (
    ("ours compat | gsplat with 3-sigma square: same rules", PUBLIC, Rules(square=True, exact_order=True)),
    ("ours | gsplat with inclusive stop: same rules", OURS_SAME_CAP, Rules(inclusive=True, exact_order=True)),
    ("ours compat | gsplat: footprint", PUBLIC, Rules()),
    ("ours | gsplat: stop", OURS_SAME_CAP, Rules()),
    ("ours as shipped | gsplat: stop, cap 0.99", DEFAULT_SETTINGS, Rules()),
)

# One setting of ours moved away from gsplat's value: a scene in which that changes nothing does not test the rule.
MOVED = (
    ("blur 0.2", replace(PUBLIC, blur=0.2)),
    ("frustum margin 0.2", replace(PUBLIC, frustum_margin=0.2)),
    ("alpha cap 0.99", replace(PUBLIC, alpha_max=0.99)),
    ("near plane 0.3", replace(PUBLIC, near=0.3)),
    ("cut at 1/250", replace(PUBLIC, alpha_min=1 / 250)),
    ("stop at 2e-4", replace(PUBLIC, transmittance_min=2e-4)),
)


def rule_rows(reference: Reference, scene: Scene, loose: Scene) -> list[Row]:
    """float64: the difference under the same rules, and the effect of each rule that differs."""
    double = torch.float64
    rows = [
        difference(label, draw_ours(scene, double, settings).image, reference.draw(scene, double, rules).image)
        for label, settings, rules in RULE_PAIRS
    ]
    exact = Rules(square=True, exact_order=True)
    shipped = reference.draw(scene, double, Rules(), shipped_lists=True).image
    quick = reference.draw(scene, double, Rules()).image
    by_bits = reference.draw(scene, double, replace(exact, exact_order=False)).image
    by_depth = reference.draw(scene, double, exact).image
    moved = [
        difference(f"same rules, but ours with {label}", draw_ours(scene, double, settings).image, by_depth)
        for label, settings in MOVED
    ]
    unturned = [draw_ours(loose, double, PUBLIC).image, reference.draw(loose, double, exact).image]
    return [
        *rows,
        difference("gsplat: its own tile lists | ours of the same rule", shipped, quick),
        difference("gsplat: order by float32 bits | by depth", by_bits, by_depth),
        difference("same rules, pose with a rotation rounded to float32", *unturned),
        *moved,
    ]


def rounding_rows(reference: Reference, scene: Scene, settings: RasterSettings, rules: Rules) -> list[Row]:
    """float32 under the same rules: rounding of each side, and what remains if float64 decides what is blended."""
    single, double = torch.float32, torch.float64
    leaves = scene.inputs(double)
    with torch.no_grad():
        decided = reference.entries(scene, leaves, reference.project(leaves, scene.camera), rules)
    ours = {dtype: draw_ours(scene, dtype, settings).image for dtype in (single, double)}
    theirs = {dtype: reference.draw(scene, dtype, rules).image for dtype in (single, double)}
    held = reference.draw(scene, single, rules, decided=decided).image
    return [
        difference("ours float32 | gsplat float32", ours[single], theirs[single]),
        difference("ours float32 | ours float64", ours[single], ours[double]),
        difference("gsplat float32 | gsplat float64", theirs[single], theirs[double]),
        difference("gsplat float32, float64 decides | gsplat float64", held, theirs[double]),
    ]


def reason_rows(reference: Reference, scene: Scene, settings: RasterSettings, rules: Rules) -> list[Row]:
    """Near misses at the pixels that differ in float32, and for scale at as many pixels spread over the image."""
    single = torch.float32
    ours, theirs = draw_ours(scene, single, settings).image, reference.draw(scene, single, rules).image
    apart = (ours - theirs)[..., :3].detach().abs().amax(-1).flatten() > VISIBLE
    chosen = apart.nonzero()[:, 0]
    spread = torch.linspace(0, len(apart) - 1, max(200, len(chosen))).long()
    return [
        {"pixels": where, "count": len(which), **near_misses(reference, scene, rules, which)}
        for where, which in (("differ by > 1e-4", chosen), ("evenly spread", spread))
    ]


def gradient_rows(reference: Reference, scene: Scene, settings: RasterSettings, rules: Rules) -> list[Row]:
    """Relative L2 (largest difference over largest entry) for each leaf."""
    single, double = torch.float32, torch.float64
    ours = {dtype: draw_ours(scene, dtype, settings).gradients(scene.upstream) for dtype in (single, double)}
    theirs = {dtype: reference.draw(scene, dtype, rules).gradients(scene.upstream) for dtype in (single, double)}
    pairs = {
        "float64: ours | gsplat": (ours[double], theirs[double]),
        "float32: ours | gsplat": (ours[single], theirs[single]),
        "ours: float32 | float64": (ours[single], ours[double]),
        "gsplat: float32 | float64": (theirs[single], theirs[double]),
    }
    return [
        {"gradient of": name, **{label: _apart(a[name], b[name]) for label, (a, b) in pairs.items()}}
        for name in theirs[double]
    ]


def _apart(a: Tensor, b: Tensor) -> str:
    if not bool(a.isfinite().all() and b.isfinite().all()):
        return f"not finite: {int((~a.isfinite()).sum())} | {int((~b.isfinite()).sum())}"
    return f"{float((a - b).norm() / b.norm()):.1e} ({_largest(a - b) / _largest(b):.1e})"


# --- times ------------------------------------------------------------------------------------------------------------


def time_rows(reference: Reference, scene: Scene, threads: int, rounds: int) -> list[Row]:
    """Forward + backward of the colour, float32, all leaves, measured alternately."""
    upstream, single = scene.upstream[..., :3].float(), torch.float32

    def backward(drawn: Drawn) -> None:
        torch.autograd.grad(drawn.image[..., :3], list(drawn.leaves.values()), upstream)

    def ours(settings: RasterSettings) -> None:
        leaves = scene.inputs(single)
        gaussians = Gaussians(**leaves, uids=torch.arange(len(leaves["means"])))
        result = rasterize(gaussians, scene.camera, scene.background.float(), settings=settings)
        torch.autograd.grad(result.color, list(leaves.values()), upstream)

    calls: dict[str, Callable[[], None]] = {
        "ours": lambda: ours(DEFAULT_SETTINGS),
        "ours, compat": lambda: ours(PUBLIC),
        "gsplat, its own tile lists": lambda: backward(reference.draw(scene, single, Rules(), shipped_lists=True)),
        "gsplat, tile lists without a Python loop": lambda: backward(reference.draw(scene, single, Rules())),
    }
    times: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(rounds + 1):  # the first is a warm-up
        for name, call in calls.items():
            torch.set_num_threads(1 if name.startswith("ours") else threads)  # torch has the cores that our kernel has
            time.sleep(0.03)  # threads of the previous call may still spin
            start = time.perf_counter()
            call()
            times[name].append(1e3 * (time.perf_counter() - start))
    torch.set_num_threads(1)
    medians = {name: statistics.median(values[1:]) for name, values in times.items()}
    return [
        {
            "forward + backward": name,
            "median ms": f"{median:.1f}",
            "minimum ms": f"{min(times[name][1:]):.1f}",
            "over ours": f"{median / medians['ours']:.0f}",
        }
        for name, median in medians.items()
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--yardstick", type=Path, required=True)
    parser.add_argument("--gaussians", type=int, nargs="+", default=[1_000, 10_000])
    parser.add_argument("--size", type=int, nargs="+", default=[200, 400])
    parser.add_argument("--views", choices=["whole", "close"], nargs="+", default=["whole", "close"])
    parser.add_argument("--threads", type=int, default=kernel.usable_cores())
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    reference, scenes = Reference(load_gsplat()), load_scenes(options.yardstick)
    threads = use_threads(options.threads)
    version = importlib.metadata.version("gsplat")
    print(f"gsplat {version}, torch {torch.__version__}, {kernel.active_isa()}, {threads} threads")
    tables = []
    for count in options.gaussians:
        for size in options.size:
            for view in options.views:
                scene = make_scene(scenes, count, size, view)
                loose = make_scene(scenes, count, size, view, rigid=False)
                # close up, the package's loop over tiles takes minutes
                rounds = options.rounds if view == "whole" else 0
                for title, rows in compare(reference, scene, loose, threads, rounds):
                    show(f"{scene.name}: {title}", rows)
                    tables.append({"n": count, "px": size, "view": view, "table": title, "rows": rows})
    if options.json is not None:
        options.json.write_text(json.dumps(tables, indent=1, allow_nan=False) + "\n")


def compare(reference: Reference, scene: Scene, loose: Scene, threads: int, rounds: int) -> list[tuple[str, list[Row]]]:
    """Every table of one scene."""
    tables = [
        ("projection", projection_rows(reference, scene)),
        ("image, float64, ours | gsplat: rules that differ", rule_rows(reference, scene, loose)),
    ]
    for label, settings, rules in RULE_PAIRS[:2]:
        tables += [
            (f"image, float32, {label}", rounding_rows(reference, scene, settings, rules)),
            (f"near misses of a decision, {label}", reason_rows(reference, scene, settings, rules)),
            (f"gradients, relative L2 (max over largest), {label}", gradient_rows(reference, scene, settings, rules)),
        ]
    if rounds > 0:
        tables.append(("times, float32", time_rows(reference, scene, threads, rounds)))
    return tables


if __name__ == "__main__":
    main()
