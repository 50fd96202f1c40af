import pytest
import torch

from nerfdiff.diffusion.ddim import ddim_sample, ddim_step, time_steps
from nerfdiff.diffusion.schedule import alpha_sigma
from nerfdiff.errors import ConfigError

MEAN, STD = 0.7, 0.3


def exact_denoiser(z, t):
    """E[x0 | Z_t] for x0 ~ N(MEAN, STD²): the optimum of the denoising loss, in closed form."""
    alpha, sigma = alpha_sigma(t)
    gain = alpha * STD**2 / (alpha**2 * STD**2 + sigma**2)
    return MEAN + gain * (z - alpha * MEAN)


@pytest.mark.parametrize("eta", [0.0, 1.0])
def test_samples_follow_the_data_distribution(eta):
    noise = torch.Generator().manual_seed(0)
    z = torch.randn(2000, 3, 2, 2, generator=noise)
    x0 = ddim_sample(exact_denoiser, z, time_steps(1000, 1.0, 0.0), eta, lambda: torch.randn(z.shape, generator=noise))
    assert x0.mean().item() == pytest.approx(MEAN, abs=0.01)
    assert x0.std().item() == pytest.approx(STD, rel=0.02)


def test_deterministic_sampling_maps_noise_by_quantiles():
    # The probability-flow ODE of a Gaussian carries z at t = 1 to MEAN + STD z.
    z = torch.linspace(-2, 2, 12).reshape(1, 3, 2, 2)
    x0 = ddim_sample(exact_denoiser, z, time_steps(1000, 1.0, 0.0))
    torch.testing.assert_close(x0, MEAN + STD * z, atol=3e-3, rtol=0)


def test_a_perfect_denoiser_keeps_the_noise_of_a_step():
    x0, eps = torch.randn(2, 1, 3, 4, 4, generator=torch.Generator().manual_seed(1)).double()
    t, t_next = torch.tensor(0.8, dtype=torch.float64), torch.tensor(0.3, dtype=torch.float64)
    (alpha, sigma), (alpha_next, sigma_next) = alpha_sigma(t), alpha_sigma(t_next)
    stepped = ddim_step(alpha * x0 + sigma * eps, x0, t, t_next, 0.0, None)
    torch.testing.assert_close(stepped, alpha_next * x0 + sigma_next * eps)


def test_ancestral_step_has_the_variance_of_the_marginal():
    t, t_next = torch.tensor(0.8), torch.tensor(0.3)
    noise = torch.Generator().manual_seed(2)
    eps, fresh = torch.randn(2, 10000, 3, 2, 1, generator=noise)
    stepped = ddim_step(alpha_sigma(t)[1] * eps, torch.zeros_like(eps), t, t_next, 1.0, fresh)
    assert stepped.std().item() == pytest.approx(alpha_sigma(t_next)[1].item(), rel=0.02)


@pytest.mark.parametrize("arguments", [(0, 1.0, 0.0), (4, 0.2, 0.5), (4, 1.1, 0.0), (4, 1.0, -0.1)])
def test_senseless_times_are_refused(arguments):
    with pytest.raises(ConfigError, match="t_min"):
        time_steps(*arguments)
