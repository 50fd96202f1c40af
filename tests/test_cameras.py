"""The camera convention against loops in float64 and a projection of its own."""

import numpy as np
import pytest
import torch

from data_fixtures import CX, CY, HEIGHT, POINTS, WIDTH, F, poses, project
from nerfdiff.cameras import Cameras


@pytest.fixture
def cameras() -> Cameras:
    K = torch.tensor([[F, 0, CX], [0, F, CY], [0, 0, 1]]).expand(4, 3, 3)
    return Cameras(torch.from_numpy(poses(4)).float(), K, HEIGHT, WIDTH)


def random_rigid(seed: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    rotation, _ = torch.linalg.qr(torch.randn(3, 3, generator=generator, dtype=torch.float64))
    transform = torch.eye(4, dtype=torch.float64)
    transform[:3, :3] = rotation * torch.linalg.det(rotation).sign()
    transform[:3, 3] = torch.randn(3, generator=generator, dtype=torch.float64) * 5
    return transform


def test_projection_is_the_textbook_pinhole(cameras):
    pixels, depth = cameras.project(torch.from_numpy(POINTS).float())
    expected = np.stack([project(c2w) for c2w in cameras.c2w.double().numpy()])
    np.testing.assert_allclose(pixels, expected[..., :2], atol=1e-3)
    np.testing.assert_allclose(depth, expected[..., 2], atol=1e-5)


def test_rays_equal_a_loop_over_pixels(cameras):
    rays = cameras.rays(0.8, torch.tensor([1.5, 1.6, 1.7, 1.8]))
    for b in range(4):
        c2w = cameras.c2w[b].double().numpy()
        for row in range(0, HEIGHT, 7):
            for column in range(0, WIDTH, 5):
                direction = c2w[:3, :3] @ [(column + 0.5 - CX) / F, (row + 0.5 - CY) / F, 1.0]
                direction /= np.linalg.norm(direction)
                np.testing.assert_allclose(rays.directions[b, row, column], direction, atol=1e-6)
                np.testing.assert_allclose(rays.origins[b, row, column], c2w[:3, 3], atol=1e-6)
    assert (rays.near == 0.8).all()
    assert rays.far[:, 0, 0].tolist() == pytest.approx([1.5, 1.6, 1.7, 1.8])
    assert rays.far.shape == rays.directions.shape[:-1] == (4, HEIGHT, WIDTH)


@pytest.mark.parametrize(
    "change",
    [
        lambda c: c,
        lambda c: c.resized(2 * HEIGHT, 3 * WIDTH),
        lambda c: c.resized(17, 23),
        lambda c: c.cropped(5, 9, 20, 30),
        lambda c: c.resized(80, 112).cropped(3, 50, 40, 41),
    ],
    ids=["stored", "enlarged", "reduced", "cropped", "enlarged and cropped"],
)
def test_points_along_a_ray_project_to_its_pixel_centre(cameras, change):
    cameras = change(cameras)
    rays = cameras.rays(0.8, 1.8)
    points = rays.at(torch.tensor([0.8, 1.3, 1.8]).expand(*rays.near.shape, 3))
    pixels, _ = cameras.project(points.flatten(1, 3))
    expected = cameras.pixel_centres()[:, :, None].expand(-1, -1, 3, -1).reshape(-1, 2)
    assert (pixels - expected).abs().max() < 1e-3
    assert expected[0].tolist() == [0.5, 0.5]
    assert expected[-1].tolist() == [cameras.width - 0.5, cameras.height - 0.5]


def test_resizing_keeps_what_the_borders_and_pixels_see(cameras):
    """Averaging 2×2 pixels puts a pixel's centre on the corner its four had in common: half a pixel off shows."""
    fine = cameras.resized(2 * HEIGHT, 2 * WIDTH)
    assert (fine.K[0] - torch.tensor([[2 * F, 0, 2 * CX], [0, 2 * F, 2 * CY], [0, 0, 1]])).abs().max() < 1e-4
    points = torch.from_numpy(POINTS).float()
    torch.testing.assert_close(fine.project(points)[0], 2 * cameras.project(points)[0])
    four = fine.rays(0.8, 1.8).directions[:, 10:12, 20:22].mean(dim=(1, 2))
    assert (four / four.norm(dim=-1, keepdim=True) - cameras.rays(0.8, 1.8).directions[:, 5, 10]).abs().max() < 1e-4


def test_cropping_shifts_pixels_and_keeps_rays(cameras):
    crop = cameras.cropped(top=5, left=9, height=20, width=30)
    points = torch.from_numpy(POINTS).float()
    shift = cameras.project(points)[0] - crop.project(points)[0]
    assert (shift - torch.tensor([9.0, 5.0])).abs().max() < 1e-4
    whole, part = cameras.rays(0.8, 1.8).directions, crop.rays(0.8, 1.8).directions
    assert (whole[:, 5:25, 9:39] - part).abs().max() < 1e-6


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_relative_poses_do_not_depend_on_the_world(cameras, seed):
    moved = Cameras((random_rigid(seed) @ cameras.c2w.double()).float(), cameras.K, HEIGHT, WIDTH)
    relative, relative_moved = cameras.relative_to(cameras[0]), moved.relative_to(moved[0])
    assert (relative.c2w - relative_moved.c2w).abs().max() < 1e-5
    assert (relative.c2w[0] - torch.eye(4)).abs().max() < 1e-6
    assert (relative.c2w[1] - torch.eye(4)).abs().max() > 0.1
    assert torch.equal(relative.K, cameras.K)


def test_relative_cameras_see_points_given_in_the_source_space(cameras):
    points = torch.from_numpy(POINTS)
    source = torch.linalg.inv(cameras.c2w[2].double())
    local = (points @ source[:3, :3].T + source[:3, 3]).float()
    pixels, depth = cameras.relative_to(cameras[2]).project(local)
    expected, expected_depth = cameras.project(points.float())
    assert (pixels - expected).abs().max() < 1e-3
    assert (depth - expected_depth).abs().max() < 1e-5


def test_relative_to_broadcasts_over_sources(cameras):
    sources = cameras[:2][:, None]
    both = cameras.relative_to(sources)
    assert both.shape == (2, 4) and both.K.shape == (2, 4, 3, 3)
    for k in range(2):
        torch.testing.assert_close(both.c2w[k], cameras.relative_to(cameras[k]).c2w)


def test_batches_index_stack_and_flatten(cameras):
    stacked = Cameras.stack([cameras, cameras[[3, 2, 1, 0]]])
    assert stacked.shape == (2, 4) and len(stacked) == 2
    assert torch.equal(stacked[1].c2w, cameras.c2w.flip(0))
    assert torch.equal(stacked.flatten().c2w[4:], cameras.c2w.flip(0))
    assert stacked.to(torch.float64).K.dtype == torch.float64
    assert torch.equal(stacked.centres, stacked.c2w[..., :3, 3])
    with pytest.raises(ValueError, match="one image size"):
        Cameras.stack([cameras, cameras.resized(20, 28)])
