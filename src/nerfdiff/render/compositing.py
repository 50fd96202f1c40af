"""The volume rendering integral (paper, eq. "nerf") by quadrature."""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import pad

from nerfdiff.precision import at_least_single


def compositing_weights(
    density: Float[Tensor, "*rays samples"], lengths: Float[Tensor, "*rays samples"]
) -> Float[Tensor, "*rays samples"]:
    """ω_i = T_i (1 − exp(−σ_i δ_i)), T_i = exp(−Σ_{j<i} σ_j δ_j).

    fp32 throughout, with T as the exponential of an exclusive cumulative sum: a bf16 cumulative product of many
    nearly transparent samples stays at 1.
    """
    optical = at_least_single(density) * at_least_single(lengths)
    # shifted: a sum less its last term has lost what came before a much larger one
    before = pad(optical.cumsum(-1)[..., :-1], (1, 0))
    return torch.exp(-before) * -torch.expm1(-optical)
