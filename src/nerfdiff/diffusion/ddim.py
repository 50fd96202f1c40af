"""DDIM sampling (Song et al. 2020) in x0 form."""

from collections.abc import Callable
from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor

from nerfdiff.diffusion.schedule import alpha_sigma, eps_from_x0
from nerfdiff.errors import ConfigError

Images = Float[Tensor, "batch 3 height width"]


def time_steps(n: int, t_max: float, t_min: float, device=None) -> Float[Tensor, "{n}+1"]:
    """n + 1 evenly spaced times from t_max down to t_min.

    Raises:
        ConfigError: not 0 <= t_min < t_max <= 1, or n < 1.
    """
    if not 0 <= t_min < t_max <= 1 or n < 1:
        raise ConfigError(f"t_min={t_min}, t_max={t_max}, steps={n}: need 0 <= t_min < t_max <= 1 and steps >= 1")
    return torch.linspace(t_max, t_min, n + 1, dtype=torch.float64, device=device).float()


def ddim_step(z: Images, x0: Images, t: Tensor, t_next: Tensor, eta: float, noise: Images | None) -> Images:
    """One step from Z_t to Z_{t_next} given the denoised x0 (DDIM eq. 12 and 16).

    Args:
        t, t_next: scalars, t > t_next.
        eta: 0 is deterministic DDIM, 1 is ancestral sampling.
        noise: standard normal, needed where eta > 0.
    """
    alpha, sigma = alpha_sigma(t)
    alpha_next, sigma_next = alpha_sigma(t_next)
    eps = eps_from_x0(z, x0, alpha, sigma)
    if eta == 0:
        return alpha_next * x0 + sigma_next * eps
    # DDIM eq. 16 with ᾱ = α²; the ratio α/α_next vanishes at t = 1, where it is still finite.
    spread = eta * sigma_next / sigma * (1 - (alpha / alpha_next) ** 2).clamp_min(0).sqrt()
    return alpha_next * x0 + (sigma_next**2 - spread**2).clamp_min(0).sqrt() * eps + spread * noise


def ddim_sample(
    denoise: Callable[[Images, Tensor], Images],
    z: Images,
    times: Float[Tensor, "times"],
    eta: float = 0.0,
    noise: Callable[[], Images] | None = None,
) -> Images:
    """Follow the reverse process along `times` and return the last denoised images.

    Args:
        denoise: (Z_t, t as a scalar) to x0.
        z: the noise at times[0].
        times: descending, one more than there are steps.
        noise: makes fresh standard normal images; needed where eta > 0.

    Returns:
        x0 at the last step, which equals Z at times[-1] = 0.
    """
    for t, t_next in pairwise(times):
        x0 = denoise(z, t)
        z = ddim_step(z, x0, t, t_next, eta, noise() if eta > 0 else None)
    return x0
