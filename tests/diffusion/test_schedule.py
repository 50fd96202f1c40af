import math

import pytest
import torch

from nerfdiff.diffusion import schedule


def naive(t: float) -> tuple[float, float]:
    return math.cos(0.5 * math.pi * t), math.sin(0.5 * math.pi * t)


def test_ends_are_exact_in_single_precision():
    alpha, sigma = schedule.alpha_sigma(torch.tensor([0.0, 1.0]))
    assert alpha.tolist() == [1.0, 0.0] and sigma.tolist() == [0.0, 1.0]


@pytest.mark.parametrize("t", [1 / 64, 0.3, 0.5, 63 / 64, 1 - 2**-20])
def test_single_precision_follows_the_closed_form(t):
    alpha, sigma = schedule.alpha_sigma(torch.tensor(t))
    expected = math.sin(0.5 * math.pi * (1 - t)), math.sin(0.5 * math.pi * t)  # = naive(t), without cancellation
    assert float(alpha) == pytest.approx(expected[0], rel=2e-7)
    assert float(sigma) == pytest.approx(expected[1], rel=2e-7)
    assert naive(t) == pytest.approx(expected, abs=1e-15)


def test_snr_near_the_noisy_end():
    # σ²/α² at t = 63/64, which guidance divides by.
    assert 1 / float(schedule.snr(torch.tensor(63 / 64))) == pytest.approx(1659.0, rel=1e-3)


@pytest.mark.parametrize("t", [0.02, 0.25, 0.5, 0.77, 0.98])
def test_conversions_agree_with_the_definitions_in_float64(t):
    generator = torch.Generator().manual_seed(0)
    x0, eps = (torch.randn(5, 3, generator=generator, dtype=torch.float64) for _ in range(2))
    alpha, sigma = (torch.tensor(c, dtype=torch.float64) for c in naive(t))
    z = alpha * x0 + sigma * eps
    v = alpha * eps - sigma * x0
    exact = {"rtol": 0, "atol": 1e-12}
    torch.testing.assert_close(schedule.add_noise(x0, eps, alpha, sigma), z, **exact)
    torch.testing.assert_close(schedule.v_from_x0_eps(x0, eps, alpha, sigma), v, **exact)
    torch.testing.assert_close(schedule.x0_from_v(z, v, alpha, sigma), x0, **exact)
    torch.testing.assert_close(schedule.eps_from_x0(z, x0, alpha, sigma), eps, **exact)


def test_velocity_form_holds_at_both_ends():
    x0, eps = torch.randn(2, 4, dtype=torch.float64)
    for t in (0.0, 1.0):
        alpha, sigma = schedule.alpha_sigma(torch.tensor(t, dtype=torch.float64))
        z, v = schedule.add_noise(x0, eps, alpha, sigma), schedule.v_from_x0_eps(x0, eps, alpha, sigma)
        torch.testing.assert_close(schedule.x0_from_v(z, v, alpha, sigma), x0)
