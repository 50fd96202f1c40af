"""Algorithm 1 on denoisers whose optimum is known: clean images of view k are N(m_k, s²), and the field is one image
that all views show, fitted exactly (N → ∞)."""

from types import SimpleNamespace

import pytest
import torch

from nerfdiff.diffusion.sampler import SAMPLERS, SamplerSettings
from nerfdiff.diffusion.schedule import alpha_sigma, expand
from nerfdiff.distill.ngd import Guidance, NGDTeacher
from nerfdiff.distill.virtual_views import VirtualViews

K, SHAPE = 5, (3, 2, 2)


class GaussianViews(VirtualViews):
    """Views whose denoiser is the exact posterior mean; all images in [-1, 1] and far from its ends."""

    def __init__(self, means: torch.Tensor, std: float, start: torch.Tensor):
        self.means, self.std, self.start = means, std, start
        self.encoding = SimpleNamespace(source=means)
        self.fixed_noise = 0.5 * torch.randn(means.shape, generator=torch.Generator().manual_seed(1)).clamp(-1, 1)

    def __len__(self) -> int:
        return K

    @property
    def first_renderings(self):
        return (0.5 * (self.start + 1)).expand(K, *SHAPE)

    def noise(self):
        return self.fixed_noise

    def denoise(self, z, t, rendered=None, deep=None):
        alpha, sigma = (expand(c, z) for c in alpha_sigma(t))
        gain = self.std**2 * alpha / (self.std**2 * alpha**2 + sigma**2)
        return self.means + gain * (z - alpha * self.means)


def run(guidance: Guidance, std: float, steps: int, t_min=0.0, sampler="ddim"):
    """The field (in [-1, 1]) after every step, where it starts, and the views."""
    means = 0.2 * torch.randn(K, *SHAPE, generator=torch.Generator().manual_seed(0)).clamp(-1.5, 1.5)
    start = torch.full(SHAPE, 0.4)
    views = GaussianViews(means, std, start)
    teacher = NGDTeacher(views, steps, SamplerSettings(1.0, t_min, "uniform_t", sampler, 0.0), guidance, "first")
    field, history = start, []
    for step in range(steps):
        targets = teacher.targets(step, (0.5 * (field + 1)).expand(K, *SHAPE))
        field = (2 * targets - 1).mean(0)  # the least-squares fit of one image to all
        history.append(field)
    return history, start, views, teacher


@pytest.mark.parametrize(("sampler", "steps"), [("ddim", 1000), ("dpmpp_2m", 100)])
def test_without_guidance_the_field_is_the_mean_of_the_views_samples(sampler, steps):
    """The probability flow of a Gaussian takes ε_k to m_k + s ε_k."""
    history, _, views, _ = run(Guidance("constant", 0.0, "current"), std=0.1, steps=steps, sampler=sampler)
    expected = (views.means + views.std * views.fixed_noise).mean(0)
    torch.testing.assert_close(history[-1], expected, atol=2e-4, rtol=0)


@pytest.mark.parametrize("schedule", [("constant", 0.5), ("linear", 0.8), ("snr", 0.3)])
@pytest.mark.parametrize("steps", [1, 8, 64])
@pytest.mark.parametrize("sampler", SAMPLERS)
def test_with_guidance_the_field_goes_to_the_mean_of_certain_views(schedule, steps, sampler):
    """For s = 0 every step is f ← (1 − w) m̄ + w f, so f − m̄ shrinks by the product of all w."""
    guidance = Guidance(*schedule, "current")
    history, start, views, teacher = run(guidance, std=0.0, steps=steps, sampler=sampler)
    mean = views.means.mean(0)
    left = torch.stack([guidance.weight(t) for t in teacher.times[:-1]]).prod()
    torch.testing.assert_close(history[-1], mean + left * (start - mean), atol=1e-5, rtol=0)
    if steps == 64:
        torch.testing.assert_close(history[-1], mean, atol=1e-4, rtol=0)


def test_guidance_pulls_uncertain_views_together():
    """With s > 0, guided views differ less from each other at the end than plain samples do."""

    def disagreement(gamma: float) -> float:
        _, _, _, teacher = run(Guidance("constant", gamma, "current"), std=0.3, steps=200)
        return float(teacher._last.var(0).mean())

    plain, half, strong = (disagreement(gamma) for gamma in (0.0, 0.5, 0.9))
    assert strong < half < plain


@pytest.mark.parametrize("gamma", [0.0, 1e-3, 1.0, 100.0])
@pytest.mark.parametrize("t_min", [0.0, 0.02])
@pytest.mark.parametrize("sampler", SAMPLERS)
def test_no_guidance_makes_numbers_that_are_none(gamma, t_min, sampler):
    for compare in ("current", "last"):
        history, *_ = run(Guidance("snr", gamma, compare), std=0.1, steps=16, t_min=t_min, sampler=sampler)
        assert all(torch.isfinite(field).all() for field in history)


@pytest.mark.parametrize("w", [0.3, 0.7])
@pytest.mark.parametrize("sampler", SAMPLERS)
def test_with_guidance_the_field_is_the_mean_of_uncertain_views_samples(w, sampler):
    """Summed over views, x̃0 − x0 is w (f − x̄0), which vanishes with the step as f follows x̄0: whatever w < 1, the mean
    of the views takes the Gaussian's own flow, from ε̄ to m̄ + s ε̄."""
    history, _, views, _ = run(Guidance("constant", w, "current"), std=0.1, steps=4000, sampler=sampler)
    expected = (views.means + views.std * views.fixed_noise).mean(0)
    torch.testing.assert_close(history[-1], expected, atol=2e-3, rtol=0)


def test_guidance_makes_uncertain_views_agree():
    """Around their mean, views are pulled together: their spread is less than that of plain samples."""
    spread = {w: run(Guidance("constant", w, "current"), std=0.1, steps=400)[3]._last.std(0).mean() for w in (0, 0.7)}
    assert spread[0.7] < 0.8 * spread[0]


def test_begun_at_less_than_one_the_views_are_the_noised_renderings():
    """Algorithm 1's first line: Z = α I_θ + σ ε. A denoiser that knows no better gives the renderings back."""
    start = torch.full(SHAPE, 0.4)
    views = GaussianViews(start.expand(K, *SHAPE), 1e4, start)
    views.denoise = lambda z, t, rendered=None, deep=None: (
        (z - expand(alpha_sigma(t)[1], z) * views.fixed_noise) / expand(alpha_sigma(t)[0], z)
    )
    teacher = NGDTeacher(
        views, 4, SamplerSettings(0.6, 0.0, "uniform_t", "ddim", 0.0), Guidance("constant", 0.0, "current"), "first"
    )
    targets = teacher.targets(0, torch.zeros(K, *SHAPE))
    torch.testing.assert_close(2 * targets - 1, start.expand(K, *SHAPE), atol=1e-5, rtol=0)
