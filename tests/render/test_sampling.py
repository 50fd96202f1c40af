import math

import pytest
import torch

from nerfdiff.render.sampling import compositing_weights, edges_between, importance_distances, in_bins, uniform_edges

NEAR, FAR = torch.tensor([0.8, 1.0]), torch.tensor([1.8, 3.0])


def test_uniform_bins_partition_the_ray():
    edges = uniform_edges(NEAR, FAR, 5)
    torch.testing.assert_close(edges[:, 0], NEAR)
    torch.testing.assert_close(edges[:, -1], FAR)
    torch.testing.assert_close(edges.diff(dim=-1), ((FAR - NEAR) / 5)[:, None].expand(2, 5))


def test_jitter_stays_in_its_bin_and_none_is_the_centre():
    edges = uniform_edges(NEAR, FAR, 4)
    jittered = in_bins(edges, torch.rand(2, 4))
    assert ((jittered >= edges[:, :-1]) & (jittered <= edges[:, 1:])).all()
    torch.testing.assert_close(in_bins(edges, None), 0.5 * (edges[:, :-1] + edges[:, 1:]))


def naive_inverse_cdf(edges, weights, u, floor):
    """By scalar arithmetic: walk the bins until the cumulated share passes u."""
    n = len(weights)
    shares = [(1 - floor) * w / sum(weights) + floor / n for w in weights]
    passed = 0.0
    for i, share in enumerate(shares):
        if u <= passed + share or i == n - 1:
            return edges[i] + (u - passed) / share * (edges[i + 1] - edges[i])
        passed += share


def test_importance_samples_follow_the_inverse_cdf():
    edges = torch.tensor([[0.5, 1.0, 1.2, 2.0, 3.0]])
    weights = torch.tensor([[0.1, 0.7, 0.0, 0.2]])
    drawn = importance_distances(edges, weights, 50, None)[0]
    expected = [naive_inverse_cdf(edges[0].tolist(), weights[0].tolist(), (i + 0.5) / 50, 1e-2) for i in range(50)]
    torch.testing.assert_close(drawn, torch.tensor(expected), atol=1e-4, rtol=0)


def test_importance_samples_ascend_and_stay_inside():
    generator = torch.Generator().manual_seed(0)
    edges = uniform_edges(torch.full((64,), 0.3), torch.full((64,), 2.0), 16)
    weights = torch.rand(64, 16, generator=generator) ** 8
    drawn = importance_distances(edges, weights, 32, torch.rand(64, 32, generator=generator))
    assert (drawn.diff(dim=-1) >= 0).all()
    assert (drawn >= 0.3).all() and (drawn <= 2.0).all()


def test_an_empty_ray_is_sampled_evenly():
    edges = uniform_edges(torch.tensor([1.0]), torch.tensor([2.0]), 8)
    drawn = importance_distances(edges, torch.zeros(1, 8), 4, None)
    torch.testing.assert_close(drawn, torch.tensor([[1.125, 1.375, 1.625, 1.875]]))


def test_no_gradient_reaches_the_choice_of_samples():
    weights = torch.rand(1, 8, requires_grad=True)
    drawn = importance_distances(uniform_edges(NEAR[:1], FAR[:1], 8), weights, 4, None)
    assert not drawn.requires_grad


def test_edges_between_samples_cover_the_ray():
    distances = torch.tensor([[1.0, 1.2, 1.5]])
    edges = edges_between(distances, torch.tensor([0.8]), torch.tensor([1.8]))
    torch.testing.assert_close(edges, torch.tensor([[0.8, 1.1, 1.35, 1.8]]))


def naive_weights(density, lengths):
    transmittance, weights = 1.0, []
    for sigma, delta in zip(density, lengths, strict=True):
        alpha = 1 - math.exp(-sigma * delta)
        weights.append(transmittance * alpha)
        transmittance *= 1 - alpha
    return weights


def test_weights_equal_the_naive_loop():
    generator = torch.Generator().manual_seed(0)
    density = 20 * torch.rand(7, 33, generator=generator, dtype=torch.float64)
    lengths = torch.rand(7, 33, generator=generator, dtype=torch.float64) / 10
    expected = torch.tensor([naive_weights(d, n) for d, n in zip(density.tolist(), lengths.tolist(), strict=True)])
    torch.testing.assert_close(compositing_weights(density, lengths), expected.double(), atol=1e-6, rtol=0)


def test_many_nearly_transparent_samples_add_up_from_bf16_inputs():
    # α = 0.0019 each: T after 128 of them is 0.784; a bf16 cumulative product stays at 1.
    density = torch.full((1, 128), 0.0019, dtype=torch.bfloat16)
    opacity = compositing_weights(density, torch.ones(1, 128)).sum()
    assert abs(1 - float(opacity) - math.exp(-128 * float(density[0, 0]))) < 1e-5


@pytest.mark.parametrize("dense", [40.0, 1e4, 1e7, 1e12, math.inf])
def test_little_before_much_is_seen_for_what_it_is(dense):
    """A sum of σδ less its last term would have swallowed the small ones: then weights add up to more than 1."""
    optical = [1e-3, 0.02, 0.3, dense, 1e-3, 5.0, dense, 0.1]
    weights = compositing_weights(torch.tensor([optical]), torch.ones(1, len(optical)))
    expected = torch.tensor([naive_weights(optical, [1.0] * len(optical))], dtype=torch.float64)
    torch.testing.assert_close(weights.double(), expected, atol=1e-7, rtol=1e-6)
    assert float(weights.double().sum()) <= 1 + 1e-6


def test_opaque_sample_hides_what_is_behind():
    weights = compositing_weights(torch.tensor([[0.0, 1e4, 5.0]]), torch.ones(1, 3))
    torch.testing.assert_close(weights, torch.tensor([[0.0, 1.0, 0.0]]))


def test_gradients_against_finite_differences():
    density = torch.rand(2, 6, dtype=torch.float64, requires_grad=True)
    lengths = torch.rand(2, 6, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(compositing_weights, (density, lengths))
