import math

import numpy as np
import pytest
import torch
from solid_scene import CENTRE, FAR, NEAR, ball_distance, balls, pictures, ring

from nerfdiff.metrics.geometry import depth_extent, floaters, heights, outside_hull
from nerfdiff.render.renderer import Renderer

RENDERER = Renderer(uniform_samples=64, importance_samples=32, background=1.0, chunk=10**6)
RADIUS = 0.3


def share(field, cameras, silhouettes, rays=10**9, margin=1, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return floaters(field, RENDERER, cameras, silhouettes, NEAR, FAR, rays, margin, 1e-4, generator)


@pytest.fixture(scope="module")
def cameras():
    return ring(6)


@pytest.fixture(scope="module")
def silhouettes(cameras):
    return pictures(cameras, RADIUS)[1] > 0


def test_the_true_solid_has_no_floaters(cameras, silhouettes):
    assert share(balls((CENTRE, RADIUS)), cameras, silhouettes) == 0


def test_a_blob_counts_by_the_area_that_it_covers(cameras, silhouettes):
    """It hovers over the axis that the cameras circle, so it is as far from all, and neither hides the other."""
    blob = ((0.0, -0.45, 1.3), 0.1)
    rays = cameras.rays(NEAR, FAR)
    areas = [int(ball_distance(rays, *ball).isfinite().sum()) for ball in ((CENTRE, RADIUS), blob)]
    # On the axis, the silhouette of a ball is a disc of radius f r / √(d² − r²) pixels.
    disc = math.pi * (1.1 * 32 * RADIUS) ** 2 / (1.3**2 - RADIUS**2)
    assert areas[0] == pytest.approx(6 * disc, rel=0.03)
    expected = areas[1] / sum(areas)
    assert expected > 0.05
    field = balls((CENTRE, RADIUS), blob)
    assert share(field, cameras, silhouettes) == pytest.approx(expected, rel=0.03)
    assert share(field, cameras, silhouettes, rays=3000) == pytest.approx(expected, rel=0.25)


def test_faint_density_counts_by_its_opacity(cameras, silhouettes):
    """Fog of optical depth τ from near to far along every ray: where the solid is not, 1 − exp(−τ) is outside."""
    tau, solid = 0.1, balls((CENTRE, RADIUS))

    def foggy(points, directions):
        rgb, density = solid(points)
        return rgb, density + tau / (FAR - NEAR)

    views = cameras[:1]
    empty = float((~silhouettes[:1]).sum())
    measured = share(foggy, views, silhouettes[:1], margin=0)
    expected = empty * -math.expm1(-tau) / (empty * -math.expm1(-tau) + float(silhouettes[:1].sum()))
    assert measured == pytest.approx(expected, rel=1e-3)


def test_a_blob_before_the_solid_is_seen_from_the_side(cameras, silhouettes):
    blob = ((0.0, 0.0, 0.85), 0.05)
    centre = torch.tensor([blob[0]])
    assert not outside_hull(centre, cameras[:1], silhouettes[:1])
    assert outside_hull(centre, cameras, silhouettes)
    covered = share(balls((CENTRE, RADIUS), blob), cameras, silhouettes)
    pixels = ball_distance(cameras.rays(NEAR, FAR), *blob).isfinite()
    union = int((pixels | silhouettes).sum())
    front = int(pixels[[0, 1, 5]].sum() + (pixels & ~silhouettes)[2:5].sum())  # from behind the solid hides it
    assert covered == pytest.approx(front / union, rel=0.1)


def test_what_no_camera_sees_is_not_outside(cameras, silhouettes):
    behind, beside, seen = (-0.4, 0.0, -1.3), (3.0, 0.0, 1.0), (0.4, 0.0, 1.3)
    outside = outside_hull(torch.tensor([behind, beside, seen, CENTRE]), cameras[:1], silhouettes[:1])
    assert outside.tolist() == [False, False, True, False]


def test_silhouettes_are_widened_by_the_margin(cameras):
    one = torch.zeros(1, 32, 32, dtype=torch.bool)
    one[:, 12:20, 12:20] = True
    # A wall before the camera, wider than the silhouette of 8×8: 10×10 of its pixels are forgiven.
    wall = lambda points, directions: (points, ((points[..., 2] > 1.2) & (points[..., 2] < 1.4)) * 1000.0)  # noqa: E731
    assert share(wall, cameras[:1], one, margin=0) == pytest.approx(1 - 64 / 1024, rel=1e-3)
    assert share(wall, cameras[:1], one, margin=1) == pytest.approx(1 - 100 / 1024, rel=1e-3)


def test_without_background_or_density_there_is_nothing_to_measure(cameras, silhouettes):
    assert share(balls((CENTRE, RADIUS)), cameras, torch.ones_like(silhouettes)) is None
    assert share(balls(), cameras, silhouettes) is None
    assert share(balls((CENTRE, RADIUS)), cameras, torch.zeros_like(silhouettes)) == pytest.approx(1)


def test_the_draw_of_rays_is_that_of_the_generator(cameras, silhouettes):
    field = balls((CENTRE, RADIUS), ((0.0, -0.45, 1.3), 0.1))
    first, again, other = (share(field, cameras, silhouettes, rays=500, seed=seed) for seed in (1, 1, 2))
    assert first == again != other


def test_heights_are_those_of_points_along_the_rays(cameras):
    _, depth = pictures(cameras, RADIUS)
    rays = cameras.rays(NEAR, FAR)
    distance = ball_distance(rays, CENTRE, RADIUS)
    hit = distance.isfinite()
    expected = rays.at(distance[..., None])[..., 0, 2][hit]
    torch.testing.assert_close(heights(depth, hit, cameras), expected.double(), atol=1e-5, rtol=0)


def plane_depth(cameras):
    """Depth, in all views, of a disc that faces the input camera where the ball's centre is; 0 elsewhere."""
    rays = cameras.rays(NEAR, FAR)
    distance = (1.3 - rays.origins[..., 2]) / rays.directions[..., 2]
    points = rays.at(distance[..., None])[..., 0, :]
    inside = (points[..., :2].norm(dim=-1) < RADIUS) & (distance > 0)
    local = torch.einsum("vji,vhwj->vhwi", cameras.c2w[:, :3, :3], points - cameras.centres[:, None, None])
    return torch.where(inside, local[..., 2], 0.0)


def extent(depth, truth, cameras, tails=0.05):
    return depth_extent(depth, (depth > 0).float(), truth, cameras, 0.5, tails)


def test_a_plane_facing_the_camera_has_no_extent(cameras):
    _, truth = pictures(cameras, RADIUS)
    plane = plane_depth(cameras)
    assert (plane > 0).sum() > 500
    assert extent(plane, truth, cameras) == pytest.approx(0, abs=1e-5)
    assert extent(truth, truth, cameras) == 1


def test_extent_is_the_ratio_of_ranges_along_the_input_axis(cameras):
    first = cameras[:1]
    _, truth = pictures(first, RADIUS)
    half = torch.where(truth > 0, 1.0 + 0.5 * (truth - 1.0), 0.0)
    assert extent(half, truth, first) == pytest.approx(0.5, rel=1e-4)
    _, whole = pictures(cameras, RADIUS)
    _, small = pictures(cameras, RADIUS / 2)
    assert extent(small, whole, cameras) == pytest.approx(0.5, rel=0.1)
    # seen from all around and with nothing left out, it is the ball's diameter
    z = heights(whole, whole > 0, cameras)
    assert float(z.max() - z.min()) == pytest.approx(2 * RADIUS, rel=0.02)


def test_the_tails_are_left_out(cameras):
    first = cameras[:1]
    _, truth = pictures(first, RADIUS)
    stray = truth.clone()
    row, column = (truth[0] > 0).nonzero()[0]
    stray[0, row, column] = FAR
    assert extent(stray, truth, first) == pytest.approx(1, abs=0.05)
    assert extent(stray, truth, first, tails=0.0) > 2
    squared = truth.square()
    ranges = [np.ptp(np.quantile(z[z > 0].double().numpy(), (0.1, 0.9))) for z in (squared, truth)]
    assert extent(squared, truth, first, tails=0.1) == pytest.approx(ranges[0] / ranges[1], rel=1e-4)


def test_extent_of_nothing_is_not_measured(cameras):
    _, truth = pictures(cameras, RADIUS)
    nothing = torch.zeros_like(truth)
    assert extent(nothing, truth, cameras) is None
    assert extent(truth, nothing, cameras) is None
    flat = torch.zeros_like(truth[:1])
    flat[:, 4:8] = 1.0
    assert extent(truth[:1], flat, cameras[:1]) is None


def test_broken_depth_shows_as_nan(cameras):
    _, truth = pictures(cameras, RADIUS)
    assert math.isnan(depth_extent(truth * torch.nan, torch.ones_like(truth), truth, cameras, 0.5, 0.05))
