import pytest
import torch

from nerfdiff.diffusion.sampler import ddim_step
from nerfdiff.diffusion.schedule import alpha_sigma


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
