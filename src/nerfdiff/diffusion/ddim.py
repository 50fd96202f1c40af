"""The DDIM step (Song et al. 2020) in x0 form."""

from jaxtyping import Float
from torch import Tensor

from nerfdiff.diffusion.schedule import alpha_sigma, eps_from_x0

Images = Float[Tensor, "batch 3 height width"]


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
