"""What the denoiser would be if clean images scattered evenly around their renderings."""

import torch
from jaxtyping import Float
from torch import Tensor


def gaussian_velocity(
    z: Float[Tensor, "*shape"],
    mean: Float[Tensor, "*shape"],
    std: float,
    alpha: Float[Tensor, "*#shape"],
    sigma: Float[Tensor, "*#shape"],
) -> tuple[Float[Tensor, "*shape"], Float[Tensor, "*#shape"]]:
    """Mean and standard deviation of v given Z_t, for x0 ~ N(mean, std²).

    With D = Z − α·mean, E[x0 | Z] = mean + std²α D / (std²α² + σ²), and v = (αZ − x0) / σ becomes
    ασ(1 − std²) D / (std²α² + σ²) − σ·mean, with no division by σ alone. What remains to be learnt is of unit
    scale at every t once divided by the standard deviation, as in EDM (Karras et al. 2022, eq. 7), whose data
    have mean zero.
    """
    variance = std**2 * alpha**2 + sigma**2
    deviation = z - alpha * mean
    return alpha * sigma * (1 - std**2) / variance * deviation - sigma * mean, std / torch.sqrt(variance)
