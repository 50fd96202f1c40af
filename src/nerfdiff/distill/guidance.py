"""NeRF guidance of the denoised images (paper, eq. "eps_guide"), in x0-space.

ε̃ = ε + γ (σ/α) (I − I_θ) is x̃0 = x0 − w (I − I_θ) with w = γ σ²/α²: for I = x0, a blend of x0 and the rendering.
For w > 1 that overshoots and for w > 2 it diverges, and σ²/α² grows without bound as t → 1; so w is clamped to [0, 1],
whose upper end is the remark of the paper that γ = SNR replaces the denoised images by the renderings.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from nerfdiff.diffusion.schedule import alpha_sigma
from nerfdiff.errors import ConfigError

SCHEDULES = ("snr", "constant", "linear")
COMPARISONS = ("current", "last")


@dataclass(frozen=True)
class Guidance:
    """How strongly views are drawn towards the field's renderings at each t.

    Args:
        schedule: `snr` is the paper's w = γ σ²/α²; `constant` is w = γ; `linear` is w = γ t.
        gamma: γ >= 0; 0 is plain sampling.
        compare: which image I the rendering is compared with: this step's (`current`, the paper's equation) or the
            `last` step's (its Algorithm 1).

    Raises:
        ConfigError: a value is none of these.
    """

    schedule: str
    gamma: float
    compare: str

    def __post_init__(self):
        if self.schedule not in SCHEDULES:
            raise ConfigError(f"guidance.schedule={self.schedule!r}: choose {', '.join(SCHEDULES)}")
        if self.compare not in COMPARISONS:
            raise ConfigError(f"guidance.compare={self.compare!r}: choose {', '.join(COMPARISONS)}")
        if not self.gamma >= 0:
            raise ConfigError(f"guidance.gamma={self.gamma} must be at least 0")

    def weight(self, t: Float[Tensor, ""]) -> Float[Tensor, ""]:
        """w in [0, 1], finite at both ends."""
        if self.schedule == "snr":
            alpha, sigma = alpha_sigma(t)
            # γσ² / α² without dividing by zero: at t = 1 any γ > 0 reaches the clamp
            numerator = self.gamma * sigma**2
            return torch.where(numerator >= alpha**2, float(self.gamma > 0), numerator / (alpha**2).clamp_min(1e-12))
        return (self.gamma * (t if self.schedule == "linear" else torch.ones_like(t))).clamp(0, 1)

    def __call__(
        self,
        x0: Float[Tensor, "views 3 height width"],
        rendered: Float[Tensor, "views 3 height width"],
        last: Float[Tensor, "views 3 height width"],
        t: Float[Tensor, ""],
    ) -> Float[Tensor, "views 3 height width"]:
        """The guided images x̃0; all in [-1, 1], which a difference to the last step's image could leave."""
        compared = x0 if self.compare == "current" else last
        return (x0 - self.weight(t) * (compared - rendered)).clamp(-1, 1)
