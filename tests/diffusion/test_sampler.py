"""Samplers against the exact flow of known data, an ODE solver, and the paper's formulas written out."""

import math
from itertools import pairwise

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

from nerfdiff.diffusion.sampler import (
    DDIM,
    SAMPLERS,
    SPACINGS,
    DPMSolverPP2M,
    Sampler,
    ddim_step,
    make_sampler,
    sample,
    time_steps,
)
from nerfdiff.diffusion.schedule import alpha_sigma
from nerfdiff.utils.errors import ConfigError

MEAN, STD = 0.7, 0.3
PAIR, WIDTH = 0.6, 0.2


def exact_denoiser(z, t):
    """E[x0 | Z_t] for x0 ~ N(MEAN, STD²): the optimum of the denoising loss, in closed form."""
    alpha, sigma = alpha_sigma(t)
    gain = alpha * STD**2 / (alpha**2 * STD**2 + sigma**2)
    return MEAN + gain * (z - alpha * MEAN)


def two_modes(z, t):
    """E[x0 | Z_t] for pixels from N(±PAIR, WIDTH²), each half of the time: not linear in Z."""
    alpha, sigma = alpha_sigma(torch.as_tensor(t))
    variance = alpha**2 * WIDTH**2 + sigma**2
    side = torch.tanh(z * alpha * PAIR / variance)  # P(+) − P(−)
    return side * PAIR + alpha * WIDTH**2 / variance * (z - alpha * PAIR * side)


def z_at(t: float, z1: torch.Tensor) -> torch.Tensor:
    """The probability flow of N(MEAN, STD²) at t, which was z1 at t = 1: quantiles stay what they are."""
    alpha, sigma = alpha_sigma(torch.tensor(t, dtype=torch.float64))
    return alpha * MEAN + torch.sqrt(alpha**2 * STD**2 + sigma**2) * z1


def z_after(denoise, z, times, sampler):
    for t, t_next in pairwise(times):
        z = sampler.step(z, denoise(z, t), t, t_next, None)
    return z


def noise(dtype=torch.float64) -> torch.Tensor:
    return torch.linspace(-2, 2, 12, dtype=dtype).reshape(1, 3, 2, 2)


@pytest.mark.parametrize("eta", [0.0, 1.0])
def test_samples_follow_the_data_distribution(eta):
    source = torch.Generator().manual_seed(0)
    z = torch.randn(2000, 3, 2, 2, generator=source)
    fresh = lambda: torch.randn(z.shape, generator=source)  # noqa: E731
    x0 = sample(exact_denoiser, z, time_steps(1000, 1.0, 0.0, "uniform_t"), DDIM(eta), fresh)
    assert x0.mean().item() == pytest.approx(MEAN, abs=0.01)
    assert x0.std().item() == pytest.approx(STD, rel=0.02)


@pytest.mark.parametrize(
    ("name", "spacing", "steps"),
    [("ddim", "uniform_t", 1000), ("dpmpp_2m", "uniform_t", 200), ("dpmpp_2m", "uniform_lambda", 60)],
)
def test_deterministic_sampling_maps_noise_by_quantiles(name, spacing, steps):
    x0 = sample(exact_denoiser, noise(torch.float32), time_steps(steps, 1.0, 0.0, spacing), make_sampler(name, 0.0))
    torch.testing.assert_close(x0, MEAN + STD * noise(torch.float32), atol=3e-3, rtol=0)


@pytest.mark.parametrize(("name", "order"), [("ddim", 1), ("dpmpp_2m", 2)])
@pytest.mark.parametrize("ends", [(1.0, 0.2), (0.9, 0.1)])
def test_the_error_falls_with_the_order_of_the_method(name, order, ends):
    """Halving the step halves DDIM's error and quarters DPM-Solver++(2M)'s, the end of noise alone included."""
    errors = [flow_error(name, torch.linspace(*ends, n + 1, dtype=torch.float64)) for n in (64, 128, 256)]
    for coarse, fine in pairwise(errors):
        assert math.log2(coarse / fine) == pytest.approx(order, abs=0.15), errors


def test_at_the_end_of_images_the_order_is_two_but_for_a_logarithm():
    """Near t = 0 evenly spaced steps are long in λ, each with an error of 1/i³ · (i/n)²: in all (log n)/n²."""
    errors = [flow_error("dpmpp_2m", torch.linspace(1, 0, n + 1, dtype=torch.float64)) for n in (256, 1024)]
    assert errors[0] / errors[1] == pytest.approx(16 * math.log(256) / math.log(1024), rel=0.3)


def flow_error(name, times):
    z = z_after(exact_denoiser, z_at(times[0].item(), noise()), times, make_sampler(name, 0.0))
    return (z - z_at(times[-1].item(), noise())).norm().item()


@pytest.mark.parametrize("ends", [(1.0, 0.0), (0.95, 0.05)])
def test_both_reach_what_an_ode_solver_reaches(ends):
    """dZ/dt = α' x0 + σ' ε, whose solution is the flow, on data whose denoiser is not linear."""

    def velocity(t, z):
        alpha, sigma = math.cos(0.5 * math.pi * t), math.sin(0.5 * math.pi * t)
        x0 = two_modes(torch.as_tensor(z), torch.tensor(t, dtype=torch.float64)).numpy()
        return 0.5 * math.pi * (-sigma * x0 + alpha * (z - alpha * x0) / sigma)

    end = max(ends[1], 1e-6)  # the right-hand side divides by σ
    solved = solve_ivp(velocity, (ends[0], end), noise().flatten().numpy(), rtol=1e-10, atol=1e-12).y[:, -1]
    errors = {}
    for name, steps in [("ddim", 512), ("dpmpp_2m", 64), ("dpmpp_2m", 512)]:
        times = torch.linspace(*ends, steps + 1, dtype=torch.float64)
        z = z_after(two_modes, noise(), times, make_sampler(name, 0.0))
        errors[name, steps] = np.abs(z.flatten().numpy() - solved).max()
    assert errors["ddim", 512] < 2e-2 and errors["dpmpp_2m", 512] < 1e-3
    assert errors["dpmpp_2m", 64] < errors["ddim", 512]


def test_the_paper_written_out():
    """Algorithm 2 of arXiv 2211.01095, in numbers of Python, on times that are not evenly spaced."""
    source = torch.Generator().manual_seed(3)
    times = [0.93, 0.8, 0.74, 0.5, 0.31, 0.06]
    images = torch.rand(len(times) - 1, 1, 3, 2, 2, generator=source, dtype=torch.float64)
    start = torch.randn(1, 3, 2, 2, generator=source, dtype=torch.float64)
    alpha, sigma = ([f(0.5 * math.pi * t) for t in times] for f in (math.cos, math.sin))
    lambdas = [math.log(a / s) for a, s in zip(alpha, sigma, strict=True)]

    expected = [start]
    for i in range(1, len(times)):
        h = lambdas[i] - lambdas[i - 1]
        if i == 1:
            extrapolated = images[0]
        else:
            r = (lambdas[i - 1] - lambdas[i - 2]) / h
            extrapolated = (1 + 1 / (2 * r)) * images[i - 1] - 1 / (2 * r) * images[i - 2]
        expected.append(sigma[i] / sigma[i - 1] * expected[-1] - alpha[i] * (math.exp(-h) - 1) * extrapolated)

    sampler, z = DPMSolverPP2M(), start
    steps = torch.tensor(times, dtype=torch.float64)
    for i in range(1, len(times)):
        z = sampler.step(z, images[i - 1], steps[i - 1], steps[i], None)
        torch.testing.assert_close(z, expected[i], atol=1e-12, rtol=1e-12)


@pytest.mark.parametrize(("t", "t_next"), [(1.0, 0.4), (0.8, 0.3), (0.2, 0.0), (1.0, 0.0)])
def test_the_first_step_is_ddims(t, t_next):
    x0, z = torch.randn(2, 1, 3, 2, 2, generator=torch.Generator().manual_seed(4))
    t, t_next = torch.tensor(t), torch.tensor(t_next)
    torch.testing.assert_close(DPMSolverPP2M().step(z, x0, t, t_next, None), ddim_step(z, x0, t, t_next, 0.0, None))


@pytest.mark.parametrize("steps", [1, 2, 3, 4, 16])
@pytest.mark.parametrize("name", SAMPLERS)
def test_from_noise_alone_to_images_alone(name, steps):
    """At t = 1, λ is −∞, and at t = 0 it is ∞: numbers all the way, and Z_0 is the last x0."""
    sampler, z = make_sampler(name, 0.0), noise(torch.float32)
    for t, t_next in pairwise(time_steps(steps, 1.0, 0.0, "uniform_t")):
        x0 = two_modes(z, t)
        z = sampler.step(z, x0, t, t_next, None)
        assert z.isfinite().all()
    torch.testing.assert_close(z, x0, atol=1e-6, rtol=0)


@pytest.mark.parametrize("spacing", SPACINGS)
@pytest.mark.parametrize("ends", [(1.0, 0.0), (0.7, 0.0), (1.0, 0.02), (0.98, 0.02)])
@pytest.mark.parametrize("n", [1, 2, 3, 8, 64])
def test_times_fall_from_one_end_to_the_other(spacing, ends, n):
    times = time_steps(n, *ends, spacing)
    assert len(times) == n + 1 and (times.diff() < 0).all()
    assert (times[0], times[-1]) == pytest.approx(ends, abs=1e-7)
    inner = times.double()[slice(1 if ends[0] == 1 else None, -1 if ends[1] == 0 else None)]
    even = inner if spacing == "uniform_t" else torch.log(torch.tan(0.5 * math.pi * inner))
    torch.testing.assert_close(
        even.diff(dim=0), even.diff(dim=0).mean().expand(max(0, len(even) - 1)), rtol=2e-3, atol=0
    )
    if spacing == "uniform_lambda" and n > 2:
        assert ends[0] < 1 or times[1] == pytest.approx(1 - (ends[0] - ends[1]) / n**2, abs=1e-6)
        assert ends[1] > 0 or times[-2] == pytest.approx((ends[0] - ends[1]) / n**2, abs=1e-6)


def test_few_steps_go_further_than_ddims():
    def error(name, steps, spacing):
        return flow_error(name, time_steps(steps, 1.0, 0.0, spacing).double())

    for steps in (8, 16, 32):
        assert error("dpmpp_2m", steps, "uniform_t") < 0.8 * error("ddim", steps, "uniform_t")
        assert error("dpmpp_2m", steps, "uniform_lambda") < 0.3 * error("ddim", steps, "uniform_t")


@pytest.mark.parametrize("name", SAMPLERS)
def test_every_sampler_is_one(name):
    assert isinstance(make_sampler(name, 0.0), Sampler)


@pytest.mark.parametrize(
    ("name", "eta", "words"),
    [("euler", 0.0, "ddim or dpmpp_2m"), ("dpmpp_2m", 0.5, "eta=0"), ("ddim", -0.1, "at least 0")],
)
def test_what_cannot_be_is_refused(name, eta, words):
    with pytest.raises(ConfigError, match=words):
        make_sampler(name, eta)


@pytest.mark.parametrize("arguments", [(0, 1.0, 0.0), (4, 0.2, 0.5), (4, 1.1, 0.0), (4, 1.0, -0.1)])
def test_senseless_times_are_refused(arguments):
    with pytest.raises(ConfigError, match="t_min"):
        time_steps(*arguments, "uniform_t")
    with pytest.raises(ConfigError, match="uniform_t or uniform_lambda"):
        time_steps(4, 1.0, 0.0, "even")


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
