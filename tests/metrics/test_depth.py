import math

import pytest
import torch

from nerfdiff.cameras import Cameras
from nerfdiff.metrics.depth import depth_errors, mask_iou, z_depth


def test_z_depth_is_the_depth_that_projection_sees():
    K = torch.tensor([[20.0, 0, 7.5], [0, 24.0, 5.0], [0, 0, 1]]).expand(2, 3, 3)
    pose = torch.eye(4).repeat(2, 1, 1)
    pose[1, :3, :3] = torch.tensor([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
    pose[1, :3, 3] = torch.tensor([0.3, -1.0, 2.0])
    cameras = Cameras(pose, K, height=10, width=16)
    distance = 1 + torch.rand(2, 10, 16, generator=torch.Generator().manual_seed(0))
    points = cameras.rays(0.0, 1.0).at(distance[..., None]).reshape(2, 160, 3)
    _, expected = cameras.project(points)
    torch.testing.assert_close(z_depth(distance, cameras), expected.reshape(2, 10, 16))


def test_depth_errors_are_those_of_a_naive_loop():
    generator = torch.Generator().manual_seed(1)
    depth, truth = (1 + torch.rand(3, 6, 7, generator=generator) for _ in range(2))
    opacity = torch.rand(3, 6, 7, generator=generator)
    truth[torch.rand(3, 6, 7, generator=generator) < 0.4] = 0
    relative, rmse = depth_errors(depth, opacity, truth, threshold=0.3)
    for n in range(3):
        errors = [
            (depth[n, y, x].item() - truth[n, y, x].item(), truth[n, y, x].item())
            for y in range(6)
            for x in range(7)
            if truth[n, y, x] > 0 and opacity[n, y, x] > 0.3
        ]
        assert relative[n] == pytest.approx(sum(abs(e) / t for e, t in errors) / len(errors))
        assert rmse[n] == pytest.approx(math.sqrt(sum(e * e for e, _ in errors) / len(errors)))


def test_depth_error_without_overlap_is_not_measured():
    ones, zeros = torch.ones(1, 4, 4), torch.zeros(1, 4, 4)
    assert depth_errors(ones, zeros, ones, 0.5) == ([None], [None])
    assert depth_errors(ones, ones, zeros, 0.5) == ([None], [None])


def test_broken_depth_shows_as_nan():
    ones = torch.ones(1, 4, 4)
    relative, rmse = depth_errors(ones * torch.nan, ones, ones, 0.5)
    assert math.isnan(relative[0]) and math.isnan(rmse[0])


def test_mask_iou_counts_pixels():
    opacity = torch.zeros(3, 4, 4)
    opacity[0, :2] = 0.9  # rows 0 and 1
    opacity[1, :, :] = 0.5  # not above the threshold
    mask = torch.zeros(3, 4, 4, dtype=torch.bool)
    mask[0, 1:] = True  # rows 1 to 3
    mask[1, 0] = True
    assert mask_iou(opacity, mask, 0.5) == [pytest.approx(1 / 4), 0.0, 1.0]
