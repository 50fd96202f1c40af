import math

import pytest
import torch

from nerfdiff.render.sampling import compositing_weights


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
