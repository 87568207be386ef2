"""A prepared scene composes the Gaussians that training composes, to the bit, and draws the same images."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import pytest
import torch
from torch import Tensor

from graings import constants, kernel
from graings.camera.camera import Camera
from graings.render import draw, render
from graings.scene.child_blocks import BLOCK, ActiveUnits, in_blocks
from graings.scene.children import compose, gather, plain_compose
from graings.scene.perceptron import perceptron, plain_perceptron
from graings.scene.prepared import KEPT_TIMES, PreparedScene, possible_children
from graings.scene.prepared_geometry import move, unmoved
from graings.scene.scene import Composed, Scene
from tests.models import EYE, tiny_scene

TIMES = (0.0, 0.31, 0.8, 1.0)
CAMERAS = [
    Camera.look_at(eye, (0.0, 0.0, 0.0), fov=0.9, width=40, height=30)
    for eye in ((0.0, -2.0, 0.5), (1.5, -2.0, 0.7), (0.3, 0.1, 0.0))
]
WHITE = (1.0, 1.0, 1.0)

CONFIGS: list[dict[str, Any]] = [
    {},
    {"time_conditioning": "concatenated"},
    {"deformation": "anchor"},
    {"deformation": "anchor", "time_conditioning": "concatenated"},
    {"deformation": "none"},
    {"single_mlp": True},
    {"single_mlp": True, "time_conditioning": "concatenated"},
    {"canonical": False},
    {"residual": False},
    {"residual_sh_degree": 0},
    {"residual_sh_degree": 3, "color_sh_degree": 1},
    {"reflection": False},
    {"reflection": False, "residual": False, "color_sh_degree": 2},
    {"opacity_view": True},
    {"child_opacity_offsets": True},
    {"child_opacity_offsets": True, "opacity_view": True},
    {"relative_scales": False},
    {"relative_scales": False, "time_conditioning": "concatenated"},
    {"projected_clip": False, "children": 1},
    {"head_width": 33, "deform_width": 40, "deform_depth": 1, "children": 7},
]


def scene_of(config: dict[str, Any], *, temporal: bool = True, anchors: int = 90) -> Scene:
    """A scene with children that are never shown, shown at some times, from some views, and always."""
    scene = tiny_scene(temporal=temporal, anchors=anchors, **config)
    with torch.no_grad():
        scene.scaffold.opacity_offsets.uniform_(-0.8, 0.1, generator=torch.Generator().manual_seed(0))
    return scene


def differing(found: Composed, expected: Composed) -> list[str]:
    """What differs in a bit between two compositions of the same view."""
    pairs = [(one.name, getattr(found.gaussians, one.name), getattr(expected.gaussians, one.name)) for one in GAUSSIANS]
    pairs.append(("children", found.children, expected.children))
    names = [name for name, here, there in pairs if not torch.equal(here, there)]
    return names + [name for name in ("blur", "sampling") if getattr(found, name) != getattr(expected, name)]


GAUSSIANS = fields(scene_of({}).gaussians(EYE, 0.0))


@pytest.mark.usefixtures("isa")
@pytest.mark.parametrize("temporal", [True, False])
@pytest.mark.parametrize("config", CONFIGS, ids=str)
def test_every_bit_of_the_gaussians_is_that_of_the_scene(config: dict[str, Any], temporal: bool) -> None:
    scene = scene_of(config, temporal=temporal)
    prepared = PreparedScene(scene)
    for time in TIMES:
        for camera in CAMERAS:
            found = prepared.compose(camera.center, time)
            with torch.no_grad():
                expected = scene.compose(camera.center, time)
            assert 0 < len(expected.children) < scene.scaffold.count * scene.scaffold.slots
            assert differing(found, expected) == []


@pytest.mark.parametrize("config", CONFIGS, ids=str)
def test_in_float64_too(config: dict[str, Any]) -> None:
    scene = scene_of(config).double()
    prepared = PreparedScene(scene)
    with torch.no_grad():
        assert differing(prepared.compose(EYE, 0.31), scene.compose(EYE, 0.31)) == []


@pytest.mark.usefixtures("isa")
def test_images_have_the_bits_of_the_path_of_training() -> None:
    scene = scene_of({})
    prepared = PreparedScene(scene)
    for camera in CAMERAS:
        expected = draw(scene.compose(camera.center, 0.31), camera, WHITE)
        for shown in (prepared, scene):
            found = render(shown, camera, 0.31, WHITE)
            assert torch.equal(found.color, expected.color)
            assert torch.equal(found.alpha, expected.alpha)


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_any_number_of_threads_gives_the_same_bits(threads: int) -> None:
    scene = scene_of({}, anchors=1500)  # several pieces of work
    with kernel.computing_threads(threads):
        found = PreparedScene(scene).compose(EYE, 0.31)
    with kernel.computing_threads(1), torch.no_grad():
        assert differing(found, scene.compose(EYE, 0.31)) == []


@pytest.mark.parametrize("config", [{}, {"opacity_view": True}, {"residual": False}], ids=str)
def test_children_left_out_are_shown_at_no_time_from_no_view(config: dict[str, Any]) -> None:
    """The residual at its bound, eta, and directions all around."""
    scene = scene_of(config | {"residual_scale": 0.3})
    random = torch.Generator().manual_seed(1)
    if scene.residual is not None:
        with torch.no_grad():
            scene.residual.out.weight.mul_(1e4)
    possible = possible_children(scene).flatten()
    assert PreparedScene(scene).children == int(possible.sum()) < len(possible)
    shown = torch.zeros_like(possible)
    for _ in range(200):
        eye, time = torch.randn(3, generator=random), float(torch.rand((), generator=random))
        with torch.no_grad():
            shown[scene.compose(eye.numpy(), time).children] = True
    assert not bool((shown & ~possible).any())
    assert int(shown.sum()) > 0.6 * int(possible.sum())  # little is kept that is never shown


def test_a_score_exactly_at_the_bound_is_left_out() -> None:
    """A residual of eta exactly, which float32 reaches, lifts a child just to the threshold: it is not shown."""
    scene = scene_of({"residual_scale": 0.125, "residual_sh_degree": 0, "children": 1})
    assert scene.residual is not None
    with torch.no_grad():
        scene.residual.out.weight.zero_()
        scene.residual.out.bias.fill_(50.0)  # tanh is 1
        scene.scaffold.opacity_offsets.zero_()
        logits = scene.appearance.opacity_logits(scene.scaffold.features, scene.directions(EYE))[:, 0]
        highest = torch.tensor(constants.ALPHA_MIN, dtype=torch.float64) - 0.125
        scene.scaffold.opacity_offsets.copy_((highest + torch.linspace(-1e-6, 1e-6, 90)).atanh().float() - logits)
        shown = scene.compose(EYE, 0.5).children
    assert 0 < len(shown) < 90
    assert possible_children(scene).flatten().nonzero().squeeze(-1).tolist() == shown.tolist()


def test_the_last_times_are_kept() -> None:
    prepared = PreparedScene(scene_of({}))
    first = prepared.compose(EYE, 0.5).gaussians
    assert prepared.compose((1.0, 2.0, 0.3), 0.5).gaussians.means is first.means
    for number in range(KEPT_TIMES):
        prepared.compose(EYE, 0.1 * number)
    again = prepared.compose(EYE, 0.5).gaussians
    assert again.means is not first.means
    assert torch.equal(again.means, first.means)


def test_a_scene_that_shows_nothing_is_an_empty_image() -> None:
    scene = scene_of({})
    with torch.no_grad():
        scene.scaffold.opacity_offsets.fill_(-5.0)
    prepared = PreparedScene(scene)
    assert prepared.children == 0
    assert torch.equal(render(prepared, CAMERAS[0], 0.4, WHITE).color, torch.ones(30, 40, 3))


def test_a_nan_reaches_the_gaussians() -> None:
    """Training finds a network that is not finite by what it draws."""
    scene = scene_of({})
    assert scene.deformation is not None
    with torch.no_grad():
        scene.deformation.out.bias[0] = torch.nan
        scene.deformation.out.bias[7] = torch.nan
        scene.appearance.color[0].bias.fill_(torch.nan)  # type: ignore[operator, union-attr]
    gaussians = PreparedScene(scene).compose(EYE, 0.4).gaussians
    assert bool(gaussians.means[:, 0].isnan().all() and gaussians.log_scales[:, 0].isnan().all())
    assert bool(gaussians.means[:, 1:].isfinite().all() and gaussians.colors.isnan().all())


@pytest.mark.usefixtures("isa")
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(("anchors", "slots"), [(1, 1), (7, 3), (400, 4)])
def test_the_motion_kernel_against_its_oracle(anchors: int, slots: int, dtype: torch.dtype) -> None:
    """Equal to the last layer and `compose` of the kernel; within the rounding of sums of the same in torch."""
    scene = tiny_scene(anchors=anchors, children=slots).to(dtype)
    assert scene.static is not None
    random = torch.Generator().manual_seed(3)
    children = torch.arange(anchors * slots)
    width, extent = 21, 1.7
    hidden = torch.randn(len(children), width, generator=random).relu().to(dtype)
    hidden[: 2 * BLOCK, 3] = 0  # left out in two blocks
    weights, bias = torch.randn(10, width, generator=random).to(dtype), torch.randn(10, generator=random).to(dtype)
    with torch.no_grad():
        gathered = gather(scene.scaffold, children)
        canonical = scene.static(scene.scaffold.features, gathered)
        rows = children[torch.rand(len(children), generator=random) < 0.6]
        arrays = (ActiveUnits.of(hidden), in_blocks(unmoved(canonical, gathered)))
        found = move(*arrays, weights, bias, extent, rows)
        offsets = [function(hidden, [weights], [bias])[:, None] for function in (perceptron, plain_perceptron)]
        (same,) = compose(canonical, gathered, offsets[0], extent, projected_clip=True)
        (plain,) = plain_compose(canonical, gathered, offsets[1], extent, projected_clip=True)
    roundoff = 2.0**-24 if dtype == torch.float32 else 2.0**-53
    # |sum| of `width` products of at most 1 x max |w|, twice its rounding, times a quaternion of length 1 or the extent
    bound = 4 * extent * (width + 4) * roundoff * float((weights.abs().sum(1) + bias.abs()).max() + 3)
    for part, exact, oracle in zip(found, same[:3], plain[:3], strict=True):
        assert torch.equal(part, exact[rows])
        torch.testing.assert_close(part, oracle[rows], rtol=0, atol=bound)


def test_blocks_hold_every_row_once() -> None:
    rows = torch.arange(2 * (BLOCK + 3), dtype=torch.float32).view(-1, 2)
    blocks = in_blocks(rows)
    assert blocks.shape == (2, 2, BLOCK)
    back: Tensor = blocks.transpose(1, 2).reshape(-1, 2)
    assert torch.equal(back[: len(rows)], rows)
    assert not bool(back[len(rows) :].any())


@pytest.mark.parametrize("rows", [[-1], [3 * BLOCK]])
def test_rows_out_of_range_are_refused(rows: list[int]) -> None:
    hidden, rest = ActiveUnits.of(torch.ones(3 * BLOCK, 5)), torch.zeros(3, 10, BLOCK)
    with pytest.raises(ValueError, match="rows"):
        move(hidden, rest, torch.zeros(10, 5), torch.zeros(10), 1.0, torch.tensor(rows))
