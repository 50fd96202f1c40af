"""The loss of an inner step against loops over its pixels."""

import math

import pytest
import torch
from torch import nn

from nerfdiff.cameras import Rays
from nerfdiff.fit.objective import FitLoss, Objective, ray_entropy, total_variation
from nerfdiff.fit.perceptual import LEAST, STAlex, shift_tolerant
from nerfdiff.utils.errors import ConfigError


def colours(rays=16, seed=0):
    return torch.rand(2, 2, rays, 3, generator=torch.Generator().manual_seed(seed)).unbind()


@pytest.mark.parametrize("weighed", [False, True])
@pytest.mark.parametrize("loss", ["mse", "l1"])
def test_losses_are_those_of_a_loop_and_errors_are_squared_whatever_the_loss(loss, weighed):
    rgb, truth = colours()
    weights = torch.rand(2, 16, generator=torch.Generator().manual_seed(3)) if weighed else None
    losses, errors = FitLoss(Objective(loss=loss))(rgb, truth, weights)
    for scene in range(2):
        total = squared = 0.0
        for ray in range(16):
            for channel in range(3):
                apart = float(rgb[scene, ray, channel]) - float(truth[scene, ray, channel])
                weight = float(weights[scene, ray]) if weighed else 1.0
                total += weight * (apart**2 if loss == "mse" else abs(apart)) / 48
                squared += apart**2 / 48
        assert float(losses[scene]) == pytest.approx(total, rel=1e-5)
        assert float(errors[scene]) == pytest.approx(squared, rel=1e-5)


@pytest.mark.parametrize("weighed", [False, True])
def test_the_perceptual_loss_sees_patches_in_their_rows(weighed):
    """Rays are laid out patch by patch, row by row; a patch weighs what its rays weigh on average."""
    side, patches = 8, 3
    rgb, truth = colours(patches * side**2)
    weights = torch.rand(2, patches * side**2, generator=torch.Generator().manual_seed(3)) if weighed else None
    plain, _ = FitLoss(Objective(patch=side))(rgb, truth, weights)
    losses, _ = FitLoss(Objective(patch=side, perceptual_weight=0.3))(rgb, truth, weights)
    distance = STAlex()
    for scene in range(2):
        total = 0.0
        for patch in range(patches):
            own = slice(patch * side**2, (patch + 1) * side**2)
            pair = [values[scene, own].T.reshape(1, 3, side, side) for values in (rgb, truth)]
            total += float(distance(*pair)) * (float(weights[scene, own].mean()) if weighed else 1.0)
        assert float(losses[scene] - plain[scene]) == pytest.approx(0.3 * total / patches, rel=1e-4)


def test_total_variation_is_that_of_a_loop_and_of_a_flat_plane_none():
    planes = torch.rand(2, 3, 2, 3, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    for scene in range(2):
        down = [
            float(planes[scene, p, c, i + 1, j] - planes[scene, p, c, i, j]) ** 2
            for p in range(3)
            for c in range(2)
            for i in range(2)
            for j in range(4)
        ]
        across = [
            float(planes[scene, p, c, i, j + 1] - planes[scene, p, c, i, j]) ** 2
            for p in range(3)
            for c in range(2)
            for i in range(3)
            for j in range(3)
        ]
        expected = sum(down) / len(down) + sum(across) / len(across)
        assert float(total_variation(planes)[scene]) == pytest.approx(expected)
    assert total_variation(torch.ones(1, 3, 2, 4, 4)).item() == 0
    assert torch.autograd.gradcheck(total_variation, planes.requires_grad_())


def entropy_of(density, jitter=None):
    """The entropy of a ray from 1 to 2 whose bins have these densities."""
    bins = len(density)
    origin, direction = torch.zeros(1, 1, 3, dtype=torch.float64), torch.tensor([[[0.0, 0.0, 1.0]]]).double()
    near = torch.ones(1, 1, dtype=torch.float64)
    jitter = torch.full((1, 1, bins), 0.5, dtype=torch.float64) if jitter is None else jitter
    return ray_entropy(lambda points, _: (points, density[None]), Rays(origin, direction, near, near + 1), jitter)


def test_entropy_is_none_of_surfaces_and_of_nothing_and_largest_of_fog():
    surface, empty = torch.tensor([0, 0, 1e4, 0]).double(), torch.zeros(4).double()
    assert float(entropy_of(surface)) == pytest.approx(0, abs=1e-6)
    assert float(entropy_of(empty)) == pytest.approx(0, abs=1e-6)
    # fog of which each bin, and what is behind, shows a fifth
    even = torch.tensor([-4 * math.log(1 - 1 / (5 - i)) for i in range(4)]).double()
    assert float(entropy_of(even)) == pytest.approx(1, abs=1e-6)


def test_entropy_is_that_of_a_loop_and_its_gradient_that_of_differences():
    density = 3 * torch.rand(5, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    left, expected = 1.0, 0.0
    for value in density.tolist():
        weight = left * (1 - math.exp(-value / 5))
        left -= weight
        expected -= weight * math.log(weight)
    expected -= left * math.log(left)
    assert float(entropy_of(density)) == pytest.approx(expected / math.log(6), rel=1e-6)
    assert torch.autograd.gradcheck(entropy_of, density.requires_grad_())


def test_settings_that_cannot_be_are_refused_with_what_can():
    for settings, message in (
        ({"loss": "l2"}, "choose mse or l1"),
        ({"patch": 0}, "patch=0 must be at least 1"),
        ({"tv_weight": -1.0}, "tv_weight=-1.0 must be at least 0"),
        ({"perceptual_weight": 0.1}, r"strategy.patch=1 is too small.*8 or more"),
    ):
        with pytest.raises(ConfigError, match=message):
            Objective(**settings)
    with pytest.raises(ConfigError, match=r"budget.rays=4096 are no whole number of patches of 24 x 24.*4032 or 4608"):
        Objective(patch=24).patches_of(4096)
    assert Objective(patch=16).patches_of(4096) == 16


def test_st_alex_is_the_packages_and_so_is_its_gradient():
    net = shift_tolerant("alex")
    first, second = torch.rand(2, 3, 3, 32, 40, generator=torch.Generator().manual_seed(0)).unbind()
    first.requires_grad_()
    expected = net(first, second, normalize=True).flatten()
    (gradient,) = torch.autograd.grad(expected.sum(), first)
    found = STAlex()(first, second)
    torch.testing.assert_close(found, expected, atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(torch.autograd.grad(found.sum(), first)[0], gradient, atol=1e-5, rtol=1e-3)


def test_images_too_small_for_the_network_are_enlarged_to_the_least_that_it_takes():
    net, distance = shift_tolerant("alex"), STAlex()
    with pytest.raises(RuntimeError, match="Padding size"):
        net(*torch.rand(2, 1, 3, LEAST - 1, LEAST - 1))
    small, other = torch.rand(2, 1, 3, 16, 16, generator=torch.Generator().manual_seed(0))
    enlarged = [nn.functional.interpolate(x, (LEAST, LEAST), mode="bilinear") for x in (small, other)]
    torch.testing.assert_close(distance(small, other), distance(*enlarged))


def test_images_without_a_feature_have_a_gradient():
    white = torch.ones(1, 3, 32, 32, requires_grad=True)
    STAlex()(white, torch.ones(1, 3, 32, 32)).sum().backward()
    assert bool(torch.isfinite(white.grad).all())
