import sys
from dataclasses import replace

import numpy as np
import pytest
import torch

from nerfdiff.cameras import Cameras
from nerfdiff.poses import look_at_origin
from nerfdiff.utils.errors import ConfigError
from procedural.cars import build_car
from procedural.colour import linear_to_srgb8, rgba, srgb_to_linear
from procedural.mesh import Model, box
from procedural.mitsuba_model import ModelWorld
from procedural.mitsuba_renderer import Film, MitsubaRenderer, resolve_variant, robust_mean
from procedural.poses import random_sphere
from procedural.texture import Texture

SIZE = 48
HALF = np.array([0.30, 0.20, 0.10])


def render(model, c2w, seed, size=SIZE, samples=4):
    film = Film(size, size, np.rad2deg(2 * np.arctan(64 / 131.25)), samples)
    return MitsubaRenderer("scalar_rgb", film).render(ModelWorld(model), c2w, seed)


def cameras(c2w):
    focal = 131.25 / 128 * SIZE
    K = torch.tensor([[focal, 0, SIZE / 2], [0, focal, SIZE / 2], [0, 0, 1]], dtype=torch.float64)
    return Cameras(torch.from_numpy(c2w), K.expand(len(c2w), 3, 3), SIZE, SIZE)


@pytest.fixture(scope="module")
def poses():
    return random_sphere(1.3, 4, np.random.default_rng(5))


@pytest.fixture(scope="module")
def car(poses):
    """A car and its views; the second pose is a small step away from the first."""
    near = look_at_origin(1.3 * np.array([np.cos(0.4) * np.cos(-1.0), np.cos(0.4) * np.sin(-1.0), np.sin(0.4)]))
    next_to = look_at_origin(1.3 * np.array([np.cos(0.5) * np.cos(-1.2), np.cos(0.5) * np.sin(-1.2), np.sin(0.5)]))
    c2w = np.stack([near, next_to, *poses])
    model = build_car(np.random.default_rng(11), {"sedan": 1.0})
    return model, c2w, render(model, c2w, 0)


def box_depth(c2w):
    """Depth of the box ±HALF by the slab method, and whether the ray comes within a hair of an edge."""
    rays = cameras(c2w[None]).rays(0.1, 3.0)
    origin, direction = rays.origins[0].numpy(), rays.directions[0].numpy()
    with np.errstate(divide="ignore"):
        a, b = (-HALF - origin) / direction, (HALF - origin) / direction
    enter, leave = np.minimum(a, b).max(axis=-1), np.maximum(a, b).min(axis=-1)
    depth = np.where(enter < leave, enter * (direction @ c2w[:3, 2]), 0)
    return depth, np.abs(enter - leave) < 1e-4


def test_depth_and_mask_are_those_of_rays_through_pixel_centres(poses):
    model = Model("box", (box("box", (0, 0, 0), 2 * HALF, (0.4, 0.4, 0.4)),))
    views = render(model, poses, 0, samples=1)
    for k, pose in enumerate(poses):
        depth, close = box_depth(pose)
        assert (depth > 0).sum() > 100
        assert np.array_equal(views.mask[k][~close], (depth > 0)[~close])
        assert np.abs(views.depth[k] - depth)[~close].max() < 2e-6


def test_a_marked_corner_appears_where_cameras_project_it(poses):
    corner = np.array([0.25, -0.15, 0.12])
    marker = box("marker", corner, (0.05, 0.05, 0.05), (0.9, 0.02, 0.02))
    body = box("body", (0, 0, 0), 2 * HALF * [1, 1, 0.9], (0.05, 0.05, 0.6))
    views = render(Model("marked", (body, marker)), poses, 0, samples=64)
    pixels, depth = cameras(poses).project(torch.from_numpy(corner).expand(len(poses), 1, 3))
    seen = 0
    for k in range(len(poses)):
        u, v = pixels[k, 0].numpy()
        if views.depth[k][int(v), int(u)] < depth[k, 0] - 0.06:
            continue  # the marker is behind the body
        seen += 1
        red = views.rgb[k].astype(float)
        redness = np.clip(red[..., 0] - red[..., 2], 0, None) * (red[..., 1] < 200)
        row, column = np.indices(redness.shape) + 0.5
        centroid = np.array([(column * redness).sum(), (row * redness).sum()]) / redness.sum()
        # Faces are lit differently, so the centroid is off by a fraction of the marker's 2 to 3 pixels.
        assert np.abs(centroid - [u, v]).max() < 0.75
    assert seen >= 2


def test_silhouette_in_colour_agrees_with_the_projected_outline_to_a_fraction_of_a_pixel():
    # A dark square of 0.2 × 0.2 facing the camera, half a pixel off centre: coverage is known exactly.
    pose = look_at_origin([0, -2.0, 0])
    plate = box("plate", (0.013, 0, -0.007), (0.2, 0.001, 0.2), (0.0, 0.0, 0.0))
    rgb = render(Model("plate", (plate,)), pose[None], 0, samples=1024).rgb[0]
    cover = 1 - srgb_to_linear(rgb[..., 0] / 255)
    row, column = np.indices(cover.shape) + 0.5
    focal = 131.25 / 128 * SIZE
    expected = SIZE / 2 + focal / 1.9995 * np.array([0.013, 0.007])
    centroid = np.array([(column * cover).sum(), (row * cover).sum()]) / cover.sum()
    assert np.abs(centroid - expected).max() < 0.03
    assert cover.sum() == pytest.approx((0.2 * focal / 1.9995) ** 2, rel=0.03)


def test_background_is_exactly_white_and_objects_are_not(car):
    _, _, views = car
    for rgb, mask, depth in zip(views.rgb, views.mask, views.depth, strict=True):
        grown = mask.copy()
        for dy in (-1, 0, 1):
            for dx in (-1, 0, 1):
                grown |= np.roll(mask, (dy, dx), axis=(0, 1))
        # One pixel around the mask may be partly covered by an edge or a mirror's tip.
        white = (rgb == 255).all(axis=-1)
        assert white[~grown].mean() > 0.998
        assert white[mask].mean() < 0.01
        assert np.array_equal(mask, depth > 0)
        assert rgb.dtype == np.uint8 and mask.dtype == bool


def test_depth_of_one_view_lands_on_the_surface_seen_in_another(car):
    _, c2w, views = car

    def agreement(target):
        cams = cameras(c2w)
        rays = cams[:1].rays(0.1, 3.0)
        forward = torch.from_numpy(c2w[0, :3, 2])
        mask = torch.from_numpy(views.mask[0])
        distance = torch.from_numpy(views.depth[0]) / (rays.directions[0] @ forward)
        points = (rays.origins[0] + distance[..., None] * rays.directions[0])[mask]
        pixels, z = Cameras(torch.from_numpy(target)[None], cams.K[:1], SIZE, SIZE).project(points[None])
        column, row = pixels[0].floor().long().clamp(0, SIZE - 1).unbind(-1)
        seen = torch.from_numpy(views.depth[1])[row, column]
        return ((z[0] - seen).abs() < 0.025).double().mean().item()

    assert agreement(c2w[1]) > 0.85
    mirrored = c2w[1] @ np.diag([-1.0, 1, 1, 1])
    assert agreement(mirrored) < 0.6


def test_headlights_and_tail_lights_appear_where_cameras_project_them(car):
    model, c2w, views = car
    # The first camera is at the front right, from where only the front's lights can be seen.
    expected = {"headlight": True, "tail_light": False}
    for name, pale in expected.items():
        parts = [p.vertices for p in model.named(name)]
        faces = [v[v[:, 1] == (v[:, 1].min() if pale else v[:, 1].max())].mean(axis=0) for v in parts]
        pixels, z = cameras(c2w[:1]).project(torch.from_numpy(np.stack(faces))[None])
        spots = [(int(v), int(u), depth) for (u, v), depth in zip(pixels[0].tolist(), z[0].tolist(), strict=True)]
        in_sight = [
            views.rgb[0][row, column] for row, column, depth in spots if depth < views.depth[0][row, column] + 0.01
        ]
        assert bool(in_sight) == pale
        assert all(colour.min() > 160 for colour in in_sight)


def test_the_same_seed_gives_the_same_noise_and_another_seed_another(poses):
    model = build_car(np.random.default_rng(1), {"suv": 1.0})
    a, b, c = (render(model, poses[:1], seed, 16).rgb for seed in (3, 3, 4))
    assert np.array_equal(a, b)
    assert not np.array_equal(a, c)


def test_srgb_conversion_against_known_values_and_its_own_inverse():
    # Middle grey: 0.2140 linear is 0.5 encoded; 0.5 linear is 188.
    assert srgb_to_linear(np.array(0.5)) == pytest.approx(0.21404114)
    assert linear_to_srgb8(np.array([0.0, 0.5, 1.0, 2.0])).tolist() == [0, 188, 255, 255]
    levels = np.arange(256)
    assert np.array_equal(linear_to_srgb8(srgb_to_linear(levels / 255)), levels)


def test_an_unknown_variant_is_refused_with_the_known_ones():
    with pytest.raises(ConfigError, match="scalar_rgb"):
        resolve_variant("opengl")


@pytest.mark.parametrize("missing", ["mitsuba", "drjit"])
def test_without_mitsuba_the_message_says_what_installs_it(missing, monkeypatch):
    monkeypatch.setitem(sys.modules, missing, None)  # importing it fails
    with pytest.raises(ConfigError, match="pip install mitsuba"):
        resolve_variant("auto")


def test_rgba_holds_straight_colours_that_composite_to_the_image_on_white():
    alpha = np.array([[0.0, 0.25, 1.0]])
    radiance = np.array([[[0.0, 0, 0], [0.125, 0.05, 0.0], [0.2159, 1.0, 0.0]]])
    values = rgba(radiance, alpha, 8)
    assert values.dtype == np.uint8 and values[0].tolist() == [[0, 0, 0, 0], [188, 124, 0, 64], [128, 255, 0, 255]]
    deep = rgba(radiance, alpha, 16)
    assert deep.dtype == np.uint16 and deep[0, 1, 3] == round(0.25 * 65535)
    assert np.abs(deep / 257 - values).max() < 0.51


def test_light_that_only_one_pass_found_is_toned_down_and_coverage_is_not():
    passes = [np.full((2, 2, 4), 0.5) for _ in range(4)]
    passes[2][0, 0, :3], passes[1][1, 1, 3] = 80.0, 1.0
    mean = robust_mean(passes)
    assert mean[0, 0, 0] < 0.6 and np.allclose(mean[0, 1], 0.5) and mean[1, 1, 3] == pytest.approx(0.625)


def test_stripes_lie_where_box_projection_puts_them():
    # One repeat, two bright stripes, over a top face of 1.2 × 0.9 whose corner is where the pattern starts.
    stripes = Texture("stripes", (0.9, 0.9, 0.9), (1.2, 1.2))
    part = replace(box("top", (0, 0, 0), (1.2, 0.9, 0.02), (0.05, 0.05, 0.05)), texture=stripes)
    rgb = render(Model("striped", (part,)), look_at_origin([0, 0, 2.01])[None], 0, samples=64).rgb[0]
    bright = stripes.pixels(part.colour)[0, :, 0] > 128
    starts = np.flatnonzero(bright & ~np.roll(bright, 1)) / len(bright)
    ends = (np.flatnonzero(bright & ~np.roll(bright, -1)) + 1) / len(bright)
    assert np.allclose(starts, [0, 0.5])
    middles = (starts + ends) / 2 * 1.2 - 0.6
    # Straight above, x points to the left of the image.
    columns = SIZE / 2 - 131.25 / 128 * SIZE * middles / 2.0
    row = rgb[SIZE // 2, :, 0].astype(int)
    assert all(row[int(c)] > 200 for c in columns)
    between = SIZE / 2 - 131.25 / 128 * SIZE * (np.array([0.4, 0.9]) * 1.2 - 0.6) / 2.0
    assert all(row[int(c)] < 100 for c in between)
    # They run along y.
    for column in (*columns, *between):
        assert np.ptp(rgb[SIZE // 2 - 6 : SIZE // 2 + 6, int(column), 0].astype(int)) < 12
