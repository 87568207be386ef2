"""Images do not depend on tiles, threads, memory contents or order, and keep the symmetries of the scene.

The limit of 2^32 pairs is not tested: reaching it needs more memory than test machines have.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from graings.camera.camera import Camera
from graings.constants import ALPHA_MIN, BLUR, TILE
from graings.gaussians import Gaussians
from graings.raster.photometric import photometric
from graings.raster.rasterize import rasterize
from graings.raster.result import DEFAULT_SETTINGS, RasterSettings, RenderResult
from tests.raster.comparison import BACKGROUND, Drawing, decisions, draw, relative, upstream
from tests.raster.evidence import within
from tests.raster.extremes import FLIP, PeakMemory, forward_bound
from tests.scenes import FLOATS, SCENES, Scene, cast, deep_stack, gaussians, overlapping, pinhole, rows

IMAGES = ("color", "alpha", "depth")
DTYPES = [torch.float32, torch.float64]


def render_view(batch: Gaussians, camera: Camera, settings: RasterSettings = DEFAULT_SETTINGS) -> RenderResult:
    return rasterize(batch, camera, torch.tensor(BACKGROUND, dtype=batch.means.dtype), settings=settings, threads=1)


def assert_same_bits(first: Drawing, second: Drawing) -> None:
    for name, image in first.images().items():
        assert torch.equal(image, second.images()[name]), name
    for name, gradient in first.gradients.items():
        assert torch.equal(gradient, second.gradients[name]), name


def product(left: Tensor, right: Tensor) -> Tensor:
    """Quaternions (w, x, y, z): the rotation `right`, then `left`."""
    a, b, c, d = left.unbind(-1)
    w, x, y, z = right.unbind(-1)
    return torch.stack(
        [
            a * w - b * x - c * y - d * z,
            a * x + b * w + c * z - d * y,
            a * y - b * z + c * w + d * x,
            a * z + b * y - c * x + d * w,
        ],
        -1,
    )


# ---- tiles


@pytest.mark.parametrize("seed", range(3))
def test_the_position_of_tiles_does_not_matter(seed: int) -> None:
    """The same window of a larger image, at every offset relative to the tiles."""
    settings = replace(DEFAULT_SETTINGS, frustum_margin=1e6)  # the clamp depends on where the image ends
    batch = gaussians(60, seed, log_scales=(-4.0, -0.5))
    small = pinhole(21, 19)
    expected = draw(rasterize, batch, small, upstream(small), settings=settings)
    for shift in range(1, TILE + 1):
        down = (5 * shift) % TILE
        large = Camera(np.eye(4), small.fx, small.fy, small.cx + shift, small.cy + down, 21 + shift + 3, 19 + down + 2)
        window = (slice(down, down + 19), slice(shift, shift + 21))
        cotangent = torch.zeros(large.height, large.width, 5, dtype=torch.float64)
        cotangent[window] = upstream(small)
        ours = draw(rasterize, batch, large, cotangent, settings=settings)
        for name, image in ours.images().items():
            torch.testing.assert_close(image[window], expected.images()[name], rtol=0, atol=1e-12)
        for name in (*FLOATS, "means2d_offset"):
            within(f"gradient of {name}", relative(ours.gradients[name], expected.gradients[name]), 1e-12)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("direction", [(1, 0), (-1, 0), (0, 1), (0, -1)])
def test_a_footprint_that_ends_at_the_edge_of_a_tile_is_treated_alike_everywhere(
    direction: tuple[int, int], dtype: torch.dtype
) -> None:
    """Variance 1, o = e^4.5 / 255 give alpha = 1/255 three pixels from the centre, to rounding.

    The centre takes every place in a tile, so that this pixel lies in the same tile or the next. Distances are rounded
    relative to a block, so a few units in the last place may decide either way, but forward and backward alike; 64 of
    them decide everywhere, which a footprint cut at the edge of a tile would not.
    """
    focal, z = 32.0, 2.0
    scale = math.sqrt(1.0 - BLUR) * z / focal
    scalar = np.float32 if dtype == torch.float32 else np.float64
    opacity = scalar(math.exp(4.5) * ALPHA_MIN)
    for steps in (-64, -8, -2, -1, 0, 1, 2, 8, 64):
        value = opacity + scalar(steps) * np.spacing(opacity)
        outcomes = []
        for phase in range(TILE):
            at = [24.5 + phase, 24.5 + phase]
            mean = [(at[0] - 32.0) * z / focal, (at[1] - 32.0) * z / focal, z]
            batch = Gaussians(
                torch.tensor([mean], dtype=dtype),
                torch.tensor([[1.0, 0.0, 0.0, 0.0]], dtype=dtype),
                torch.full((1, 3), math.log(scale), dtype=dtype),
                torch.tensor([float(value)], dtype=dtype),
                torch.ones(1, 3, dtype=dtype),
                torch.zeros(1, dtype=torch.int64),
            )
            camera = pinhole(64, 64, focal=focal)
            column, row = (int(at[axis] - 0.5) + 3 * direction[axis] for axis in (0, 1))
            cotangent = torch.zeros(64, 64, 5, dtype=torch.float64)
            cotangent[row, column, 3] = 1.0
            # no margin and no variance from the slope of the projection: x / z would add to it
            still = draw(rasterize, batch, camera, cotangent, settings=replace(DEFAULT_SETTINGS, frustum_margin=-1.0))
            alpha = still.result.alpha[row, column].item()
            assert (alpha > 0) == (still.gradients["opacities"].item() > 0), (steps, phase)
            outcomes.append(alpha)
        if abs(steps) == 64:
            assert all((alpha > 0) == (steps > 0) for alpha in outcomes), steps


def test_a_gaussian_crosses_the_edge_of_a_tile_without_a_jump() -> None:
    """In steps of a thousandth of a pixel. o G has slope 0.607 / sqrt(0.3) = 1.11 at most; 1/255 is the cut."""
    batch = replace(
        gaussians(1, 60, spread=0.0, opacity=(1.0, 1.0)), log_scales=torch.full((1, 3), -9.0, dtype=torch.float64)
    )
    camera = pinhole(48, 32)
    background = torch.zeros(3, dtype=torch.float64)
    before = None
    for step in range(0, 12000, 10):
        # one step in ten keeps this short
        for part in (0, 1):
            offset = torch.tensor([[10.0 + (step + part) * 1e-3 - 24.0, 0.3]], dtype=torch.float64)
            alpha = rasterize(batch, camera, background, means2d_offset=offset, threads=1).alpha
            if part:
                change = (alpha - before).abs().max().item()
                assert 0 < change <= 1.11 * 1e-3 + 1 / 255, step
            before = alpha


# ---- size


def memory_model(pairs: int, gaussian_count: int, pixels: int, deepest: int, threads: int) -> int:
    """Bytes that forward and backward take in float32: pairs, rows, images, and the scratch of each thread."""
    per_pair = 4 + 4 + 2 + 48  # row, slot, mask; twelve sums
    per_gaussian = 64 + 16 + 1 + 8 * (1 + 2) + 4 * (4 + 2 * 16)
    per_pixel = 4 * 5 * 3  # image, upstream, and the products that the loss keeps
    per_entry = 256 + 4 + 2 * 16 * 16 * 4
    return pairs * per_pair + gaussian_count * per_gaussian + pixels * per_pixel + threads * deepest * per_entry


def frame_of(result: RenderResult) -> object:
    """What the kernel keeps for the gradient."""
    return result.color.grad_fn.frame  # type: ignore[union-attr]


def test_two_thousand_gaussians_over_the_whole_image_fit_into_the_predicted_memory() -> None:
    """2.4 million pairs of tile and Gaussian at 640 x 480."""
    count, camera = 2000, pinhole(640, 480, focal=500.0)
    batch = cast(gaussians(count, 61, spread=0.3, log_scales=(1.5, 2.0), opacity=(0.3, 0.6)), torch.float32)
    leaves = {name: getattr(batch, name).requires_grad_() for name in FLOATS}
    upstreams = upstream(camera)[..., :3].float()
    with PeakMemory() as memory:
        result = rasterize(batch, camera, torch.zeros(3), threads=2)
        pairs = frame_of(result).pairs  # type: ignore[attr-defined]
        result.color.backward(upstreams)
    assert pairs == count * math.ceil(640 / TILE) * math.ceil(480 / TILE)
    assert result.color.isfinite().all()
    assert all(leaf.grad.isfinite().all() and leaf.grad.abs().sum() > 0 for leaf in leaves.values())
    within("bytes at the peak", memory.taken, 1.1 * memory_model(pairs, count, 640 * 480, count, 2))


@pytest.mark.slow(reason="twelve megapixels in both precisions")
def test_twelve_megapixels_with_gaussians_over_all_of_them_keep_their_gradient() -> None:
    """1e5 small Gaussians and 200 that fill 4000 x 3000 pixels, forward, SSIM and backward."""
    camera = pinhole(4000, 3000, focal=3000.0)
    small = gaussians(100_000, 62, log_scales=(-7.0, -5.5), opacity=(0.1, 0.9))
    large = gaussians(200, 63, spread=0.2, log_scales=(0.0, 0.7), opacity=(0.005, 0.03))
    joined = {name: torch.cat([getattr(large, name), getattr(small, name)]) for name in FLOATS}
    batch = cast(Gaussians(**joined, uids=torch.arange(100_200)), torch.float32)
    target = torch.rand(3000, 4000, 3, generator=torch.Generator().manual_seed(0))

    def gradients(chosen: Gaussians, v_color: Tensor | None) -> tuple[dict[str, Tensor], Tensor]:
        leaves = {name: getattr(chosen, name).clone().requires_grad_() for name in FLOATS}
        background = torch.tensor(BACKGROUND, dtype=chosen.means.dtype)
        color = rasterize(replace(chosen, **leaves), camera, background, threads=2).color
        if v_color is None:
            (v_color,) = torch.autograd.grad(photometric(color, target, 0.2, threads=2), color, retain_graph=True)
        color.backward(v_color.to(color.dtype))
        return {name: leaf.grad[:200] for name, leaf in leaves.items() if leaf.grad is not None}, v_color

    with PeakMemory() as memory:
        single, v_color = gradients(batch, None)
    assert memory.peak < 2.5e9
    double, _ = gradients(cast(batch, torch.float64), v_color)
    for name, gradient in single.items():
        assert gradient.isfinite().all(), name
        within(f"gradient of {name}", relative(gradient, double[name]), 1e-5)


# ---- sums of light


@pytest.mark.parametrize("build", [overlapping, deep_stack])
def test_opacity_has_no_gradient_if_everything_has_one_colour(build: Callable[[], Scene]) -> None:
    """T (q - Q) is 0 for every contributor, to 4 units of roundoff of q; so is the sum over pixels."""
    batch, camera = build()
    batch = cast(replace(batch, colors=torch.full_like(batch.colors, 0.5)), torch.float32)
    leaves = {name: getattr(batch, name).clone().requires_grad_() for name in ("opacities", "colors")}
    ground = torch.full((3,), 0.5)
    color = rasterize(replace(batch, **leaves), camera, ground, threads=1).color
    color.backward(torch.ones_like(color))
    opacities, colors = leaves["opacities"].grad, leaves["colors"].grad
    assert opacities is not None
    assert colors is not None
    weights = colors[:, 0]  # the sum of alpha T over pixels
    drawn = weights > 0
    assert drawn.sum() > 50
    # q = 0.5 + 0.5 + 0.5 of what one pixel sends back
    assert (opacities[drawn].abs() * batch.opacities[drawn] / (1.5 * weights[drawn])).max().item() <= 4 * 2.0**-24


@pytest.mark.parametrize("name", SCENES)
def test_every_pixel_is_a_convex_combination(name: str) -> None:
    """Weights and transmittance add up to 1, and alpha and colours stay in their range."""
    batch, camera = SCENES[name]()
    batch = cast(batch, torch.float32)
    bound = forward_bound(decisions(cast(batch, torch.float64), camera).deepest)
    white = rasterize(replace(batch, colors=torch.ones_like(batch.colors)), camera, torch.ones(3), threads=1)
    within("sum of weights and transmittance less 1", (white.color - 1).abs().max().item(), bound)
    ours = render_view(batch, camera)
    assert ours.alpha.min() >= 0
    assert ours.alpha.max() <= 1
    assert ours.color.min() >= 0
    highest = torch.maximum(batch.colors.max(0).values, torch.tensor(BACKGROUND))
    assert (ours.color - highest).max().item() <= bound


@pytest.mark.parametrize("name", ["overlapping", "deep_stack", "opaque"])
def test_transmittance_never_rises_as_gaussians_are_added_behind(name: str) -> None:
    """To the last bit."""
    batch, camera = SCENES[name]()
    batch = cast(batch, torch.float32)
    batch = rows(batch, batch.means[:, 2].argsort())
    before = torch.ones(camera.height, camera.width)
    for count in range(0, len(batch) + 1, max(1, len(batch) // 60)):
        left = 1 - render_view(rows(batch, torch.arange(count)), camera).alpha
        assert (left <= before).all()
        before = left


# ---- symmetries


def quantised(scene: Scene) -> Scene:
    """Means on a grid of 2^-10, so that dyadic shifts and turns by right angles are exact in float32."""
    batch, camera = scene
    return replace(batch, means=(batch.means * 1024).round() / 1024), camera


def assert_images_agree(ours: RenderResult, expected: RenderResult, steady: Tensor, bound: float) -> None:
    for name in IMAGES:
        image, other = getattr(ours, name), getattr(expected, name)
        unit = max(1.0, other.abs().max().item()) if name == "depth" else 1.0
        difference = (image - other).abs() / unit
        within(name, difference[steady].max().item(), bound)
        assert (difference[~steady] <= FLIP).all(), name


def cube_rotations() -> Iterator[np.ndarray]:
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            turn = np.eye(3)[list(order)] * np.array(signs)[:, None]
            if np.linalg.det(turn) > 0:
                yield turn


def quaternion_of(turn: np.ndarray) -> Tensor:
    """A quaternion of small whole numbers, any length: of a rotation that permutes the axes."""
    for numbers in itertools.product((0.0, 1.0, -1.0), repeat=4):
        w, x, y, z = numbers
        n = w * w + x * x + y * y + z * z
        if n == 0:
            continue
        made = (
            np.array(
                [
                    [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
                    [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
                    [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z],
                ]
            )
            / n
        )
        if np.array_equal(made, turn):
            return torch.tensor(numbers)
    raise AssertionError("every rotation of the cube has one")


def test_moving_scene_and_camera_together_gives_the_same_image() -> None:
    """24 rotations of the cube, each with a dyadic translation."""
    batch, camera = quantised(overlapping())
    batch = cast(batch, torch.float32)
    steady = decisions(cast(batch, torch.float64), camera).steady
    expected = render_view(batch, camera)
    turns = list(cube_rotations())
    assert len(turns) == 24
    for index, turn in enumerate(turns):
        shift = np.array([0.5, -2.25, 8.0]) * (index % 5 - 2)
        moved = replace(
            batch,
            means=batch.means @ torch.tensor(turn).float().T + torch.tensor(shift).float(),
            quats=product(quaternion_of(turn), batch.quats),
        )
        pose = np.eye(4)
        pose[:3, :3] = turn.T
        pose[:3, 3] = -turn.T @ shift
        there = Camera(pose, camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height)
        assert_images_agree(render_view(moved, there), expected, steady, 4e-6)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("exponent", [-13, -3, 3, 10, 17])
def test_lengths_times_a_power_of_two_give_the_same_bits(exponent: int, dtype: torch.dtype) -> None:
    """Positions and near plane, with scales that the blur outweighs: rho + k ln 2 is not exact, so see below."""
    factor = 2.0**exponent
    batch, camera = gaussians(60, 64), pinhole()
    batch = cast(replace(batch, log_scales=torch.full_like(batch.log_scales, -60.0)), dtype)
    turned = Camera.look_at((0.3, -0.2, 0.1), (0.1, 0.3, 3.0), fov=1.0, width=48, height=32)
    for view in (camera, turned):
        pose = np.array(view.world_to_camera)
        pose[:3, 3] *= factor
        scaled_view = Camera(pose, view.fx, view.fy, view.cx, view.cy, view.width, view.height)
        scaled = replace(batch, means=batch.means * factor)
        settings = replace(DEFAULT_SETTINGS, near=DEFAULT_SETTINGS.near * factor)
        cotangent = upstream(view)
        first = draw(rasterize, batch, view, cotangent)
        cotangent = cotangent * torch.tensor([1, 1, 1, 1, 1 / factor], dtype=torch.float64)  # depth is a length
        second = draw(rasterize, scaled, scaled_view, cotangent, settings=settings)
        assert first.result.alpha.max() > 0.1
        for name in ("color", "alpha"):
            assert torch.equal(first.images()[name], second.images()[name]), name
        assert torch.equal(first.images()["depth"] * factor, second.images()["depth"])
        for name in ("opacities", "colors", "means2d_offset", "background"):
            assert torch.equal(first.gradients[name], second.gradients[name]), name
        assert torch.equal(first.gradients["means"], second.gradients["means"] * factor)


@pytest.mark.parametrize("exponent", [-13, -3, 3, 10, 17])
def test_scaling_positions_and_scales_together_gives_the_same_image(exponent: int) -> None:
    """rho + k ln 2 has a relative rounding error of 2^-52, which does not show in twelve digits of the image."""
    factor = 2.0**exponent
    batch, camera = overlapping()
    scaled = replace(batch, means=batch.means * factor, log_scales=batch.log_scales + exponent * math.log(2))
    settings = replace(DEFAULT_SETTINGS, near=DEFAULT_SETTINGS.near * factor)
    first, second = render_view(batch, camera), render_view(scaled, camera, settings)
    torch.testing.assert_close(second.color, first.color, rtol=0, atol=1e-12)
    torch.testing.assert_close(second.alpha, first.alpha, rtol=0, atol=1e-12)
    torch.testing.assert_close(second.depth / factor, first.depth, rtol=0, atol=1e-11)
    assert second.culled == first.culled


@pytest.mark.parametrize("name", ["overlapping", "needles", "off_centre", "wide"])
def test_a_mirrored_scene_gives_the_mirrored_image(name: str) -> None:
    """x -> -x and cx -> W - cx; the quaternion of a rotation keeps w and x and negates y and z."""
    batch, camera = SCENES[name]()
    batch = cast(batch, torch.float32)
    choice = decisions(cast(batch, torch.float64), camera)
    mirrored = replace(
        batch,
        means=batch.means * torch.tensor([-1.0, 1.0, 1.0]),
        quats=batch.quats * torch.tensor([1.0, 1.0, -1.0, -1.0]),
    )
    there = Camera(np.eye(4), camera.fx, camera.fy, camera.width - camera.cx, camera.cy, camera.width, camera.height)
    flipped = render_view(mirrored, there)
    flipped = replace(flipped, **{field: getattr(flipped, field).flip(1) for field in IMAGES})
    assert_images_agree(flipped, render_view(batch, camera), choice.steady, forward_bound(choice.deepest))


# ---- threads and memory


@pytest.fixture(params=DTYPES, ids=["single", "double"])
def clean_drawing(request: pytest.FixtureRequest) -> tuple[Gaussians, Camera, Drawing]:
    """Drawn by one thread, before anything is done to the memory."""
    batch, camera = cast(gaussians(600, 65, spread=0.7, log_scales=(-4.0, -1.0)), request.param), pinhole(90, 70)
    return batch, camera, draw(rasterize, batch, camera, upstream(camera), threads=1)


def test_previous_memory_contents_do_not_matter(
    clean_drawing: tuple[Gaussians, Camera, Drawing], dirty_memory: None
) -> None:
    """Twenty times, with 1, 2, 4 and 8 threads in turn."""
    batch, camera, clean = clean_drawing
    assert torch.empty(1 << 16).isnan().all(), "the memory is not dirty"
    cotangent = upstream(camera)
    for threads in (1, 2, 4, 8) * 5:
        assert_same_bits(clean, draw(rasterize, batch, camera, cotangent, threads=threads))


def test_previous_memory_contents_do_not_matter_where_nothing_is_drawn(dirty_memory: None) -> None:
    """Early exits write all outputs, forward and backward."""
    camera = pinhole(35, 18)
    visible = gaussians(5, 66, spread=0.02, log_scales=(-5.0, -4.0))  # the middle tiles only
    for batch in (visible, replace(visible, means=-visible.means), gaussians(0, 66)):
        drawing = draw(rasterize, batch, camera, upstream(camera))
        assert all(image.isfinite().all() for image in drawing.images().values())
        assert all(gradient.isfinite().all() for gradient in drawing.gradients.values())
        assert drawing.result.radii.isfinite().all()
        assert drawing.result.means2d.isfinite().all()
        assert torch.equal(drawing.result.color[0, 0], torch.tensor(BACKGROUND, dtype=torch.float64))


def test_many_gaussians_are_sorted_alike_by_any_number_of_threads() -> None:
    """40 000 Gaussians at 97 depths: threads share the sort, and uids decide among hundreds of equal depths."""
    count, camera = 40_000, pinhole()
    batch = cast(gaussians(count, 69, log_scales=(-6.0, -4.0), opacity=(0.05, 0.5)), torch.float32)
    means = batch.means.clone()
    means[:, 2] = 2 + torch.arange(count) % 97 / 64
    batch = replace(batch, means=means)
    shuffle = torch.randperm(count, generator=torch.Generator().manual_seed(1))
    cotangent = upstream(camera)
    one = draw(rasterize, batch, camera, cotangent, threads=1)
    for threads in (2, 4, 8):
        assert_same_bits(one, draw(rasterize, batch, camera, cotangent, threads=threads))
        other = draw(rasterize, rows(batch, shuffle), camera, cotangent, threads=threads)
        assert all(torch.equal(image, one.images()[name]) for name, image in other.images().items())
        for name in (*FLOATS, "means2d_offset"):
            assert torch.equal(other.gradients[name], one.gradients[name][shuffle]), name


# ---- order


def test_swapping_two_gaussians_in_depth_changes_a_pixel_by_their_overlap() -> None:
    """Equal depth, the camera turned by a billionth either way: the jump is T a_i a_j |c_i - c_j|."""
    batch = gaussians(2, 67, spread=0.0, log_scales=(-1.5, -1.0), opacity=(0.7, 0.7))
    means = torch.tensor([[-0.1, 0.0, 3.0], [0.1, 0.0, 3.0]], dtype=torch.float64)
    batch = replace(batch, means=means, colors=torch.tensor([[0.9, 0.1, 0.4], [0.2, 0.8, 0.3]], dtype=torch.float64))
    # something in front of both, so that T is not 1
    front = replace(gaussians(1, 68, spread=0.0, depth=(2.0, 2.0), opacity=(0.4, 0.4)), uids=torch.tensor([9]))
    both = Gaussians(
        *(torch.cat([getattr(front, name), getattr(batch, name)]) for name in FLOATS), torch.tensor([9, 0, 1])
    )
    base = pinhole()

    def turned(angle: float) -> Camera:
        pose = np.eye(4)
        pose[0, 0] = pose[2, 2] = math.cos(angle)
        pose[0, 2], pose[2, 0] = math.sin(angle), -math.sin(angle)
        return Camera(pose, base.fx, base.fy, base.cx, base.cy, base.width, base.height)

    first, second = (render_view(both, turned(angle)).color for angle in (1e-9, -1e-9))
    jump = (first - second).norm(dim=2)
    alphas = [render_view(rows(both, torch.tensor([i])), base).alpha for i in range(3)]
    difference = (batch.colors[0] - batch.colors[1]).norm()
    expected = (1 - alphas[0]) * alphas[1] * alphas[2] * difference
    assert expected.max().item() > 0.1
    within("jump", (jump - expected).abs().max().item(), 1e-6)
