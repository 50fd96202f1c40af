"""The reverse process: DDIM, or DPM-Solver++(2M) in fewer steps, behind one interface.

A sampler takes denoised images. Its caller may change them before each step, which is how views are guided: the guided
x̃0 takes the place of x0.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from nerfdiff.diffusion.deep_features import DeepReuse
from nerfdiff.diffusion.schedule import alpha_sigma, eps_from_x0
from nerfdiff.utils.errors import ConfigError

Images = Float[Tensor, "batch 3 height width"]


def ddim_step(z: Images, x0: Images, t: Tensor, t_next: Tensor, eta: float, noise: Images | None) -> Images:
    """Step from Z_t to Z_{t_next} given the denoised x0 (DDIM, arXiv 2010.02502, eq. 12 and 16).

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


@runtime_checkable
class Sampler(Protocol):
    """A sampler of one run of the reverse process; it may keep earlier steps, so every run has its own."""

    needs_noise: bool
    """True if steps take fresh noise."""

    def step(self, z: Images, x0: Images, t: Tensor, t_next: Tensor, noise: Images | None) -> Images:
        """Step from Z_t to Z_{t_next}.

        Args:
            x0: the denoised images, guided or not.
            t, t_next: scalars, t > t_next; each call begins at the t_next of the last.
            noise: standard normal where `needs_noise`.
        """


class DDIM:
    """Song et al. 2020, arXiv 2010.02502; first order in the step.

    Args:
        eta: 0 is deterministic, 1 is ancestral sampling.
    """

    def __init__(self, eta: float):
        self.eta = eta
        self.needs_noise = eta > 0

    def step(self, z: Images, x0: Images, t: Tensor, t_next: Tensor, noise: Images | None) -> Images:
        return ddim_step(z, x0, t, t_next, self.eta, noise)


class DPMSolverPP2M:
    """DPM-Solver++(2M) (Lu et al. 2022, arXiv 2211.01095, algorithm 2); deterministic, second order in the step.

    Its step, (σ'/σ) Z − α' (e^{−h} − 1) D with h = λ' − λ and λ = log(α/σ), is DDIM's with D for x0: the line through
    this and the last x0 over λ, half a step ahead. As long as there is no line, D is x0: in the first step, in the
    second after t = 1 (λ = −∞), and in the last to t = 0 (λ = ∞). There both methods are one, and finite.
    """

    needs_noise = False

    def __init__(self):
        self._last: tuple[Images, Tensor] | None = None

    def step(self, z: Images, x0: Images, t: Tensor, t_next: Tensor, noise: Images | None) -> Images:
        ahead = x0
        if self._last is not None:
            last_x0, last_t = self._last
            # 1 / (2r) of the paper, r = h_last / h
            share = 0.5 * (half_log_snr(t_next) - half_log_snr(t)) / (half_log_snr(t) - half_log_snr(last_t))
            ahead = x0 + torch.where(share.isfinite(), share, 0.0) * (x0 - last_x0)
        self._last = x0, t
        return ddim_step(z, ahead, t, t_next, 0.0, None)


def half_log_snr(t: Tensor) -> Tensor:
    """Return λ = log(α/σ), from ∞ at t = 0 to −∞ at t = 1."""
    alpha, sigma = alpha_sigma(t)
    return alpha.log() - sigma.log()


SAMPLERS = ("ddim", "dpmpp_2m")
SPACINGS = ("uniform_t", "uniform_lambda")


@dataclass(frozen=True)
class SamplerSettings:
    """Settings of the reverse process; `conf/common/sampler.yaml` has them.

    Args:
        t_max, t_min: times where it starts and ends, in [0, 1].
        spacing: of the times between, `uniform_t` or `uniform_lambda` (see `time_steps`).
        sampler: `ddim` or `dpmpp_2m`.
        eta: DDIM's η; 0 is deterministic given the initial noise.
        deep: how often the U-Net's deep levels are computed; None: at each step.
    """

    t_max: float
    t_min: float
    spacing: str
    sampler: str
    eta: float
    deep: DeepReuse | None = None

    def begin(self) -> Sampler:
        """Make a sampler for one run, see `make_sampler`."""
        return make_sampler(self.sampler, self.eta)

    def times(self, steps: int, device=None) -> Float[Tensor, "{steps}+1"]:
        """Return the times of so many steps, see `time_steps`."""
        return time_steps(steps, self.t_max, self.t_min, self.spacing, device)


def make_sampler(name: str, eta: float) -> Sampler:
    """Make a sampler for one run.

    Args:
        name: `ddim` or `dpmpp_2m`.
        eta: of DDIM; `dpmpp_2m` is deterministic and takes 0 only.

    Raises:
        ConfigError: another name, or an eta that cannot be.
    """
    if name not in SAMPLERS:
        raise ConfigError(f"sampler={name!r}: choose {' or '.join(SAMPLERS)}")
    if not eta >= 0:
        raise ConfigError(f"eta={eta} must be at least 0")
    if name == "dpmpp_2m" and eta > 0:
        raise ConfigError(f"sampler=dpmpp_2m is deterministic and takes eta=0, got eta={eta}; sampler=ddim takes both")
    return DDIM(eta) if name == "ddim" else DPMSolverPP2M()


def time_steps(n: int, t_max: float, t_min: float, spacing: str, device=None) -> Float[Tensor, "{n}+1"]:
    """Return n + 1 times from t_max down to t_min.

    Args:
        spacing: `uniform_t`; or `uniform_lambda`, evenly over λ = log(α/σ), which suits DPM-Solver++ in few steps. λ is
            infinite at t = 1 and t = 0: the steps from and to there go as far in t as 1/n² of the way, which leaves
            them an error that falls as fast as the others'.

    Raises:
        ConfigError: not 0 <= t_min < t_max <= 1, n < 1, or another spacing.
    """
    if not 0 <= t_min < t_max <= 1 or n < 1:
        raise ConfigError(f"t_min={t_min}, t_max={t_max}, steps={n}: need 0 <= t_min < t_max <= 1 and steps >= 1")
    if spacing not in SPACINGS:
        raise ConfigError(f"spacing={spacing!r}: choose {' or '.join(SPACINGS)}")
    if spacing == "uniform_t":
        return torch.linspace(t_max, t_min, n + 1, dtype=torch.float64, device=device).float()
    from_noise, to_images = t_max == 1, t_min == 0
    short = (t_max - t_min) / n**2
    finite = torch.tensor([t_max - short * from_noise, t_min + short * to_images], dtype=torch.float64)
    inner = n + 1 - from_noise - to_images
    share = torch.linspace(0, 1, inner, dtype=torch.float64) if inner > 1 else torch.full((inner,), 0.5).double()
    between = 2 / math.pi * torch.atan(torch.exp(-torch.lerp(*half_log_snr(finite), share)))
    times = torch.cat([between.new_ones(int(from_noise)), between, between.new_zeros(int(to_images))])
    times[0], times[-1] = t_max, t_min  # exactly
    return times.float().to(device)


def time_at(times: Float[Tensor, "times"], step: float | int) -> Float[Tensor, ""]:
    """Return the time at a place on a schedule; between two steps it is on the line between their times."""
    before = int(step)
    return times[before] if before == step else times[before].lerp(times[before + 1], step - before)


def sample(
    denoise: Callable[[Images, Tensor], Images],
    z: Images,
    times: Float[Tensor, "times"],
    sampler: Sampler,
    noise: Callable[[], Images] | None = None,
) -> Images:
    """Follow the reverse process along `times` and return the last denoised images.

    Args:
        denoise: (Z_t, t as a scalar) to x0.
        z: the noise at times[0].
        times: descending, one more than there are steps.
        sampler: a fresh one.
        noise: makes fresh standard normal images, where the sampler needs them.

    Returns:
        x0 at the last step, which equals Z at times[-1] = 0.
    """
    for t, t_next in pairwise(times):
        x0 = denoise(z, t)
        z = sampler.step(z, x0, t, t_next, noise() if sampler.needs_noise else None)
    return x0
