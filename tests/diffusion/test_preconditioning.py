import pytest
import torch

from nerfdiff.diffusion.denoiser import gaussian_velocity
from nerfdiff.diffusion.schedule import add_noise, alpha_sigma, v_from_x0_eps


@pytest.mark.parametrize("t", [0.05, 0.3, 0.7, 0.95])
def test_against_regression_on_samples(t):
    """v regressed on Z over many draws is the closed form, and what the regression leaves has its deviation."""
    noise = torch.Generator().manual_seed(0)
    mean, std = 0.4, 0.25
    alpha, sigma = alpha_sigma(torch.tensor(t, dtype=torch.float64))
    x0 = mean + std * torch.randn(400_000, generator=noise, dtype=torch.float64)
    eps = torch.randn(400_000, generator=noise, dtype=torch.float64)
    z, v = add_noise(x0, eps, alpha, sigma), v_from_x0_eps(x0, eps, alpha, sigma)
    predicted, deviation = gaussian_velocity(z, torch.full_like(z, mean), std, alpha, sigma)
    design = torch.stack([torch.ones_like(z), z], 1)
    fitted = design @ torch.linalg.lstsq(design, v[:, None]).solution
    torch.testing.assert_close(predicted, fitted[:, 0], atol=5e-3, rtol=0)
    assert float((v - predicted).std()) == pytest.approx(float(deviation), rel=5e-3)


def test_both_ends_are_finite():
    """At t = 1 the best guess is the mean itself; at t = 0, where Z is clean, v = ε is unknown and guessed zero."""
    z, mean = torch.randn(2, 5), torch.randn(2, 5)
    alpha, sigma = (c[:, None] for c in alpha_sigma(torch.tensor([0.0, 1.0])))
    v, deviation = gaussian_velocity(z, mean, 0.2, alpha, sigma)
    torch.testing.assert_close(v, torch.stack([torch.zeros(5), -mean[1]]))
    torch.testing.assert_close(deviation, torch.tensor([[1.0], [0.2]]))
