"""Guidance in x0-space against the paper's ε-form, and at both ends of t."""

import pytest
import torch

from nerfdiff.diffusion.schedule import alpha_sigma, eps_from_x0
from nerfdiff.distill.ngd import Guidance
from nerfdiff.utils.errors import ConfigError


def images(seed: int):
    noise = torch.Generator().manual_seed(seed)
    return [0.1 * torch.randn(2, 3, 4, 5, generator=noise, dtype=torch.float64) for _ in range(4)]


@pytest.mark.parametrize("compare", ["current", "last"])
@pytest.mark.parametrize("t", [0.1, 0.35, 0.5])
def test_equals_the_papers_score_where_that_is_stable(t, compare):
    """ε̃ = ε + γ (σ/α)(I − I_θ), then x̃0 from ε̃ (eq. "eps_guide"), with w = γσ²/α² <= 1."""
    z, x0, rendered, last = images(0)
    t = torch.tensor(t, dtype=torch.float64)
    alpha, sigma = alpha_sigma(t)
    gamma = 0.7 * float((alpha / sigma) ** 2)
    compared = x0 if compare == "current" else last
    eps = eps_from_x0(z, x0, alpha, sigma) + gamma * sigma / alpha * (compared - rendered)
    guided = Guidance("snr", gamma, compare)(x0, rendered, last, t)
    torch.testing.assert_close(guided, (z - sigma * eps) / alpha)


def test_gamma_of_the_snr_replaces_images_by_renderings_and_zero_leaves_them():
    _, x0, rendered, last = images(1)
    t = torch.tensor(0.3, dtype=torch.float64)
    alpha, sigma = alpha_sigma(t)
    snr = float((alpha / sigma) ** 2)
    torch.testing.assert_close(Guidance("snr", snr, "current")(x0, rendered, last, t), rendered)
    assert torch.equal(Guidance("snr", 0.0, "current")(x0, rendered, last, t), x0)


@pytest.mark.parametrize("schedule", ["snr", "constant", "linear"])
def test_weights_stay_between_0_and_1_from_one_end_of_t_to_the_other(schedule):
    for gamma in (0.0, 1e-6, 0.3, 1.0, 100.0, 1e8):
        weights = torch.stack([Guidance(schedule, gamma, "current").weight(t) for t in torch.linspace(0, 1, 65)])
        assert torch.isfinite(weights).all() and weights.min() >= 0 and weights.max() <= 1
        assert (weights.diff() >= 0).all(), "more noise, more guidance"
        assert (gamma > 0) == bool(weights.max() > 0)


@pytest.mark.parametrize("schedule", ["snr", "constant", "linear"])
def test_below_a_time_there_is_no_guidance_and_above_it_is_as_without(schedule):
    every, late = Guidance(schedule, 0.7, "current"), Guidance(schedule, 0.7, "current", t_min=0.4)
    for t in torch.linspace(0, 1, 11, dtype=torch.float64):
        assert late.weight(t) == (every.weight(t) if t >= 0.4 else 0)
    _, x0, rendered, last = images(1)
    assert torch.equal(late(x0, rendered, last, torch.tensor(0.3)), x0)


@pytest.mark.parametrize("compare", ["current", "last"])
@pytest.mark.parametrize("gamma", [0.3, 1.0])
def test_guided_images_stay_images(compare, gamma):
    """Against a naive loop in float64; a rendering and a last image that differ much lead out of [-1, 1]."""
    x0, rendered, last = (values.sign().float() * 0.9 for values in images(2)[:3])
    guided = Guidance("constant", gamma, compare)(x0, rendered, last, torch.tensor(0.5))
    triples = zip(*(values.flatten().tolist() for values in (x0, rendered, last)), strict=True)
    free = [x - gamma * ((x if compare == "current" else before) - seen) for x, seen, before in triples]
    assert (max(free) > 1) == (compare == "last")
    expected = torch.tensor([max(-1.0, min(1.0, value)) for value in free]).reshape(guided.shape)
    torch.testing.assert_close(guided, expected)


def test_unknown_settings_are_refused_with_the_known_ones():
    for arguments in (
        ("cosine", 1.0, "current"),
        ("snr", 1.0, "first"),
        ("snr", -1.0, "current"),
        ("snr", 1.0, "current", 2.0),
    ):
        with pytest.raises(ConfigError, match="guidance"):
            Guidance(*arguments)
