"""The ray caster against closed forms: a silhouette, the shading of single pixels, depth, shadow, reflection."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from graings.capture.synthetic.drawing import draw
from graings.capture.synthetic.exact import Vector, lengths, unit
from graings.capture.synthetic.pose import at
from graings.capture.synthetic.raycast import OCCLUSION, lit_share, open_share, trace
from graings.capture.synthetic.shading import shade, surroundings
from graings.capture.synthetic.shapes import Ball, Disc
from graings.capture.synthetic.textures import Plain
from graings.capture.synthetic.viewpoint import Viewpoint, look
from graings.capture.synthetic.world import Light, Part, World

RADIUS, DISTANCE, FOCAL = 0.5, 4.0, 1.4
ALBEDO: Vector = (0.6, 0.3, 0.2)
BALL = Part(Ball(RADIUS), Plain(ALBEDO))


def ahead(size: int) -> Viewpoint:
    return look((DISTANCE, 0.0, 0.0), (0.0, 0.0, 0.0), FOCAL, size)


def lit(direction: Vector) -> Light:
    return replace(Light(), direction=unit(direction))


def world(*parts: Part, light: Light | None = None) -> World:
    shown = light or Light()
    return World(parts, light=lambda time: shown)


def centers(viewpoint: Viewpoint) -> tuple[np.ndarray, np.ndarray]:
    rows, columns = np.divmod(np.arange(viewpoint.size**2), viewpoint.size)
    return viewpoint.rays(columns + 0.5, rows + 0.5)


def test_the_silhouette_of_a_ball_is_a_disc() -> None:
    size = 120
    alpha = draw(world(BALL), ahead(size), 0.0).rgba[..., 3] / 255.0
    # A ball seen along its axis is a disc of radius f r / sqrt(d^2 - r^2).
    radius = FOCAL * size * RADIUS / np.sqrt(DISTANCE**2 - RADIUS**2)
    rows, columns = np.mgrid[:size, :size] + 0.5 - size / 2
    off = np.hypot(rows, columns) - radius
    assert (alpha[off < -0.75] == 1.0).all()
    assert (alpha[off > 0.75] == 0.0).all()
    # On the rim the share of the pixel inside, to about one of eight samples; the mean error is far smaller.
    edge = np.abs(off) < 0.75
    assert np.abs(alpha - np.clip(0.5 - off, 0.0, 1.0))[edge].max() < 0.25
    assert alpha.sum() == pytest.approx(np.pi * radius**2, rel=2e-3)


def test_depth_is_where_the_ray_meets_the_ball() -> None:
    viewpoint = ahead(101)
    depth = draw(world(BALL), viewpoint, 0.0).depth.reshape(-1)
    directions, forward = centers(viewpoint)
    along = -DISTANCE * directions[0]  # of the nearest point to the centre
    inside = RADIUS**2 - (DISTANCE**2 - along**2)
    hit = inside > 1e-3
    expected = (along[hit] - np.sqrt(inside[hit])) * forward[hit]
    np.testing.assert_allclose(depth[hit], expected, atol=2e-5)
    assert (depth[inside < 0] == 0.0).all()


def test_one_pixel_of_a_ball_has_the_closed_form_of_its_shading() -> None:
    light = lit((0.8, 0.3, 0.5))
    view = draw(world(BALL, light=light), ahead(101), 0.0)
    # The central ray meets the ball at (r, 0, 0) with the normal (1, 0, 0): half-way between sky and ground.
    expected = []
    for albedo, color, sky, ground in zip(ALBEDO, light.color, light.sky, light.ground, strict=True):
        linear = albedo * (0.5 * (sky + ground) + color * light.direction[0])
        expected.append(round(255.0 * linear**0.5))
    assert view.rgba[50, 50].tolist() == [*expected, 255]


def test_a_highlight_has_its_closed_form() -> None:
    light = lit((0.8, 0.3, 0.5))
    glossy = replace(BALL, gloss=0.5, sharpness=3)
    view = draw(world(glossy, light=light), ahead(101), 0.0)
    half = unit((light.direction[0] + 1.0, light.direction[1], light.direction[2]))
    linear = ALBEDO[0] * (0.5 * (light.sky[0] + light.ground[0]) + light.color[0] * light.direction[0])
    linear += light.color[0] * 0.5 * half[0] ** 8
    assert view.rgba[50, 50, 0] == round(255.0 * linear**0.5)


def test_exposure_multiplies_light() -> None:
    full = draw(world(BALL), ahead(21), 0.0).rgba[10, 10, :3] / 255.0
    half = draw(replace(world(BALL), exposure=lambda time: 0.25), ahead(21), 0.0).rgba[10, 10, :3] / 255.0
    np.testing.assert_allclose(half, 0.5 * full, atol=1 / 255)


def test_a_shadow_is_dark_inside_soft_at_its_rim_and_ends() -> None:
    light = lit((0.0, 0.0, 1.0))
    floor = Part(Disc(3.0, 0.05), Plain(ALBEDO), pose=lambda time: at(0.0, 0.0, -1.05))
    instant = world(BALL, floor, light=light).at(0.0)
    x = np.linspace(0.0, 1.5, 301)
    points = np.stack([x, np.zeros(301), np.full(301, -1.0)])
    normals = np.repeat(np.array([[0.0], [0.0], [1.0]]), 301, axis=1)
    share = lit_share(instant, points, normals, np.ones(301, dtype=np.int64))
    assert (share[x < 0.40] == 0.0).all()
    assert (share[x > 0.60] == 1.0).all()
    assert (np.diff(share) >= -0.02).all()
    # The light's rim is cut in half where the ray touches the ball.
    assert share[np.argmin(np.abs(x - RADIUS))] == pytest.approx(0.5, abs=0.05)


def test_a_pixel_in_full_shadow_has_ambient_light_only() -> None:
    light = lit((0.0, 0.0, 1.0))
    floor = Part(Disc(3.0, 0.05), Plain(ALBEDO), pose=lambda time: at(0.0, 0.0, -1.05))
    viewpoint = look((3.0, 0.0, 1.0), (0.1, 0.0, -1.0), FOCAL, 51)
    view = draw(world(BALL, floor, light=light), viewpoint, 0.0)
    assert view.rgba[25, 25, 0] == round(255.0 * (ALBEDO[0] * light.sky[0]) ** 0.5)


def test_a_touching_part_takes_ambient_light_away() -> None:
    floor = Part(Disc(3.0, 0.05), Plain(ALBEDO), pose=lambda time: at(0.0, 0.0, -RADIUS - 0.05))
    x = np.linspace(0.0, 2.0, 101)
    points = np.stack([x, np.zeros(101), np.full(101, -RADIUS)])
    up = np.repeat(np.array([[0.0], [0.0], [1.0]]), 101, axis=1)
    share = open_share(world(BALL, floor).at(0.0), points, up, np.ones(101, dtype=np.int64))
    assert share[0] == 1.0 - OCCLUSION
    assert (np.diff(share) >= 0.0).all()
    assert (share[x > 0.7] == 1.0).all()


def test_a_mirror_shows_what_lies_in_the_mirrored_direction() -> None:
    mirror = replace(BALL, mirror=1.0, texture=Plain((1.0, 1.0, 1.0)))
    point, normal = np.array([[RADIUS], [0.0], [0.0]]), np.array([[1.0], [0.0], [0.0]])
    seen_along = np.array([[-0.6], [0.0], [-0.8]])
    color = shade(world(mirror).at(0.0), point, seen_along, np.zeros(1, dtype=np.int64), 1e-3)
    np.testing.assert_allclose(color, surroundings(seen_along + 1.2 * normal), atol=1e-6)


def test_a_mirror_shows_a_body_behind_the_viewer() -> None:
    mirror = replace(BALL, mirror=1.0, texture=Plain((1.0, 1.0, 1.0)))
    behind = Part(Ball(1.0), Plain((0.0, 0.0, 0.0)), pose=lambda time: at(7.0, 0.0, 0.0))
    assert draw(world(mirror, behind), ahead(101), 0.0).rgba[50, 50, :3].tolist() == [0, 0, 0]


def test_a_wire_thinner_than_a_pixel_is_not_missed() -> None:
    size = 40
    pixel = DISTANCE / (FOCAL * size)
    wire = Part(Disc(3.0, 0.15 * pixel, 0.01 * pixel), Plain(ALBEDO))
    alpha = draw(world(wire), ahead(size), 0.0).rgba[..., 3] / 255.0
    # Seen edge-on at distance 1, a plate covers 0.3 of the pixels' height times the magnification there.
    covered = alpha.sum(axis=0)
    assert covered.min() > 0.0
    assert covered.max() <= 2.5


def test_the_mask_is_where_moving_parts_are() -> None:
    moving = replace(BALL, moves=True, pose=lambda time: at(0.0, 1.2, 0.0))
    view = draw(world(BALL, moving), ahead(64), 0.0)
    alone = draw(world(moving), ahead(64), 0.0)
    np.testing.assert_array_equal(view.moving, alone.rgba[..., 3])
    assert draw(world(BALL), ahead(64), 0.0).moving.max() == 0


def test_rays_from_the_same_place_meet_the_nearest_part() -> None:
    far = replace(BALL, pose=lambda time: at(-2.0, 0.0, 0.0))
    viewpoint = ahead(31)
    directions, _ = centers(viewpoint)
    hits = trace(world(far, BALL).at(0.0), np.array(viewpoint.origin)[:, None], directions, viewpoint.pixel)
    assert set(hits.part[hits.part >= 0].tolist()) == {1}
    points = np.array(viewpoint.origin)[:, None] + hits.t[hits.part >= 0] * directions[:, hits.part >= 0]
    np.testing.assert_allclose(lengths(points), RADIUS, atol=2e-5)
