import pytest
import torch

from model_fixtures import input_cameras
from nerfdiff.field.triplane import Triplane

HEIGHT, WIDTH, NEAR, FAR = 6, 10, 0.8, 1.8


def triplane(planes: torch.Tensor) -> Triplane:
    batch = planes.shape[0]
    cameras = input_cameras(batch, HEIGHT, WIDTH)
    return Triplane(planes, cameras, torch.full((batch,), NEAR), torch.full((batch,), FAR))


def point_at(column: float, row: float, depth_texel: float, texels: int) -> torch.Tensor:
    """The point whose projection is that texel's centre and whose depth is that texel's, by hand."""
    K = input_cameras(1, HEIGHT, WIDTH).K[0]
    z = NEAR + (depth_texel + 0.5) / texels * (FAR - NEAR)
    return torch.stack([(column + 0.5 - K[0, 2]) / K[0, 0] * z, (row + 0.5 - K[1, 2]) / K[1, 1] * z, torch.tensor(z)])


def random_planes(batch: int = 1) -> torch.Tensor:
    return torch.randn(batch, 3, 4, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(0))


@pytest.mark.parametrize(("column", "row"), [(0, 0), (9, 0), (0, 5), (3, 4)])
def test_the_xy_plane_is_the_input_image_pixel_for_pixel(column, row):
    planes = random_planes()
    planes[:, 1:] = 0
    features, _ = triplane(planes).sample(point_at(column, row, 2.2, HEIGHT)[None, None])
    torch.testing.assert_close(features[0, 0], planes[0, 0, :, row, column], atol=1e-5, rtol=0)


@pytest.mark.parametrize(("column", "depth"), [(0, 0), (9, 5), (7, 1)])
def test_the_xz_plane_has_depth_along_its_height(column, depth):
    planes = random_planes()
    planes[:, [0, 2]] = 0
    features, _ = triplane(planes).sample(point_at(column, 1.3, depth, HEIGHT)[None, None])
    torch.testing.assert_close(features[0, 0], planes[0, 1, :, depth, column], atol=1e-5, rtol=0)


@pytest.mark.parametrize(("row", "depth"), [(0, 0), (5, 9), (1, 7)])
def test_the_yz_plane_has_depth_along_its_width(row, depth):
    planes = random_planes()
    planes[:, :2] = 0
    features, _ = triplane(planes).sample(point_at(4.4, row, depth, WIDTH)[None, None])
    torch.testing.assert_close(features[0, 0], planes[0, 2, :, row, depth], atol=1e-5, rtol=0)


@pytest.mark.parametrize(("plane", "ignored"), [(0, 2), (1, 1), (2, 0)])
def test_each_plane_ignores_exactly_one_axis(plane, ignored):
    planes = torch.zeros(1, 3, 4, HEIGHT, WIDTH)
    planes[:, plane] = random_planes()[:, plane]
    here = [3.3, 2.1, 2.6]
    reference, _ = triplane(planes).sample(point_at(*here, HEIGHT)[None, None])
    for axis in range(3):
        there = list(here)
        there[axis] += 1.4
        moved, _ = triplane(planes).sample(point_at(*there, HEIGHT)[None, None])
        same = torch.allclose(moved, reference, atol=1e-5)
        assert same == (axis == ignored)


def test_half_a_pixel_is_half_way_between_texels():
    planes = random_planes()
    planes[:, 1:] = 0
    features, _ = triplane(planes).sample(point_at(3.5, 2, 2.0, HEIGHT)[None, None])
    torch.testing.assert_close(features[0, 0], planes[0, 0, :, 2, 3:5].mean(-1), atol=1e-5, rtol=0)


def test_frustum_corners_are_plus_and_minus_one():
    corner = torch.stack(
        [point_at(-0.5, -0.5, -0.5, HEIGHT), point_at(WIDTH - 0.5, HEIGHT - 0.5, HEIGHT - 0.5, HEIGHT)]
    )
    coordinates, _ = triplane(random_planes()).frustum_coordinates(corner[None])
    torch.testing.assert_close(coordinates[0], torch.tensor([[-1.0] * 3, [1.0] * 3]), atol=1e-5, rtol=0)


def test_points_before_the_near_plane_are_masked_not_mirrored():
    in_front = point_at(2.0, 4.0, 3.0, HEIGHT)
    points = torch.stack([in_front, -in_front, torch.tensor([0.1, 0.0, 0.0]), torch.tensor([0.0, 0.0, NEAR - 1e-3])])
    features, valid = triplane(random_planes()).sample(points[None])
    assert valid.tolist() == [[True, False, False, False]]
    assert features.isfinite().all()


def test_batches_do_not_mix():
    planes, points = random_planes(3), torch.randn(3, 7, 3, generator=torch.Generator().manual_seed(1)) * 0.1
    points[..., 2] += 1.3
    together, _ = triplane(planes).sample(points)
    for i in range(3):
        alone, _ = triplane(planes[i : i + 1]).sample(points[i : i + 1])
        torch.testing.assert_close(together[i : i + 1], alone)


def test_coordinates_stay_fp32_under_autocast():
    points = point_at(3.37, 2.11, 2.6, HEIGHT)[None, None]
    expected, _ = triplane(random_planes()).sample(points)
    with torch.autocast("cpu", torch.bfloat16):
        features, _ = triplane(random_planes()).sample(points)
    assert torch.equal(features, expected)
