"""Confidence by reprojection on a plane before cameras side by side, whose warp is a shift by whole pixels."""

import pytest
import torch

from nerfdiff.cameras import Cameras
from nerfdiff.fit.confidence import Confidence
from nerfdiff.utils.errors import ConfigError

SIZE, FAR, SHIFT = 16, 2.0, 3
FOCAL = 16.0


def cameras(count: int) -> Cameras:
    """Cameras in a row: from each to the next, a point of the plane z = FAR moves SHIFT pixels to the left."""
    c2w = torch.eye(4).repeat(1, count, 1, 1)
    c2w[0, :, 0, 3] = torch.arange(count) * SHIFT * FAR / FOCAL
    K = torch.tensor([[FOCAL, 0, SIZE / 2], [0, FOCAL, SIZE / 2], [0, 0, 1]])
    return Cameras(c2w, K.expand(1, count, 3, 3), SIZE, SIZE)


def plane(count: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Images of a random texture on the plane, and distances to it along the rays."""
    texture = torch.rand(3, SIZE, SIZE + SHIFT * count, generator=torch.Generator().manual_seed(0))
    images = torch.stack([texture[..., SHIFT * view : SHIFT * view + SIZE] for view in range(count)])
    rays = cameras(count).rays(torch.tensor(1.0), torch.tensor(1.0))
    return images[None], FAR / rays.directions[..., 2]


def test_views_that_agree_weigh_the_same():
    images, depth = plane(3)
    weights = Confidence(0.1).weights(images, depth, cameras(3))
    torch.testing.assert_close(weights, torch.ones_like(weights), atol=2e-4, rtol=0)


def test_weights_are_those_of_a_loop_over_pixels():
    """Of two views with independent noise, compared pixel by pixel where the other sees the place."""
    images, depth = plane(2)
    images = (images + 0.2 * torch.randn(images.shape, generator=torch.Generator().manual_seed(1))).clamp(0, 1)
    weights = Confidence(0.1, neighbours=5).weights(images, depth, cameras(2))
    expected = torch.ones(1, 2, SIZE, SIZE)
    for view, shift in ((0, -SHIFT), (1, SHIFT)):
        for row in range(SIZE):
            for column in range(SIZE):
                there = column + shift
                if 0 <= there < SIZE:
                    apart = images[0, view, :, row, column] - images[0, 1 - view, :, row, there]
                    expected[0, view, row, column] = torch.exp(-apart.abs().mean() / 0.1)
    torch.testing.assert_close(weights, expected / expected.mean(), atol=2e-3, rtol=1e-2)


def test_a_pixel_that_one_view_has_wrong_weighs_less_there_and_where_it_is_compared():
    images, depth = plane(3)
    wrong = images.clone()
    wrong[0, 1, :, 5, 8] = 1 - wrong[0, 1, :, 5, 8].round()
    weights = Confidence(0.1).weights(wrong, depth, cameras(3))[0]
    low = (weights < 0.5 * weights.max()).nonzero().tolist()
    assert [1, 5, 8] in low and [0, 5, 8 + SHIFT] in low and [2, 5, 8 - SHIFT] in low
    assert all(abs(row - 5) <= 1 for _, row, _ in low)  # and no other row, of which bilinear lookups see a little


def test_what_something_hides_is_not_compared():
    """A neighbour that sees something much nearer says nothing of the place behind."""
    images, depth = plane(2)
    images[0, 1], depth[0, 1] = 0.0, 0.5 * depth[0, 1]
    weights = Confidence(0.1).weights(images, depth, cameras(2))
    torch.testing.assert_close(weights[0, 0], weights[0, 0, :1, :1].expand(SIZE, SIZE))


@pytest.mark.parametrize("views", [1, 2])
def test_scenes_do_not_depend_on_each_other(views):
    images, depth = plane(views)
    others = torch.rand(images.shape, generator=torch.Generator().manual_seed(2))
    both = Cameras(cameras(views).c2w.repeat(2, 1, 1, 1), cameras(views).K.repeat(2, 1, 1, 1), SIZE, SIZE)
    together = Confidence(0.1).weights(torch.cat([images, others]), depth.repeat(2, 1, 1, 1), both)
    for scene, own in enumerate((images, others)):
        torch.testing.assert_close(together[scene], Confidence(0.1).weights(own, depth, cameras(views))[0])
    assert together.flatten(1).mean(1).tolist() == pytest.approx([1, 1])


def test_numbers_that_cannot_be_are_refused():
    for settings in ({"scale": 0.0}, {"scale": 0.1, "neighbours": 0}, {"tolerance": -1.0}):
        with pytest.raises(ConfigError, match=r"strategy.confidence.\w+=.* must be above 0"):
            Confidence(**settings)
