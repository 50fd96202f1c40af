"""The kernels, in Triton's interpreter where there is no GPU, against PyTorch's operators in float64."""

import logging

import pytest
import torch
from torch import nn

from nerfdiff.diffusion import norm_silu as module
from nerfdiff.diffusion.norm_silu import fused, norm_silu, reference

pytest.importorskip("triton")

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"


def inputs(channels: int, size: tuple[int, int], modulated: bool, mean: float = 0.0) -> list[torch.Tensor | None]:
    """x, weight, bias and scale_shift in float64."""
    noise = torch.Generator().manual_seed(channels)
    x = mean + torch.randn(2, channels, *size, generator=noise, dtype=torch.float64)
    weight, bias = torch.randn(2, channels, generator=noise, dtype=torch.float64)
    scale_shift = torch.randn(2, 2 * channels, generator=noise, dtype=torch.float64) if modulated else None
    return [x, weight, bias, scale_shift]


def run(how, tensors, dtype) -> tuple[torch.Tensor, list[torch.Tensor]]:
    """Output and gradients of all inputs, for a loss that weights every number differently."""
    leaves = [t if t is None else t.detach().to(DEVICE, dtype, copy=True).requires_grad_() for t in tensors]
    x, weight, bias, scale_shift = leaves
    norm = nn.GroupNorm(32, len(weight), device=DEVICE, dtype=dtype)
    norm.weight, norm.bias = nn.Parameter(weight.detach().clone()), nn.Parameter(bias.detach().clone())
    out = how(norm, x.contiguous(memory_format=torch.channels_last), scale_shift)
    weights = torch.linspace(-1, 1, out.numel(), device=DEVICE, dtype=torch.float64).reshape(out.shape)
    (out * weights).sum().backward()
    gradients = [x.grad, norm.weight.grad, norm.bias.grad] + ([] if scale_shift is None else [scale_shift.grad])
    return out, gradients


@pytest.mark.parametrize("modulated", [False, True])
@pytest.mark.parametrize(("channels", "size"), [(32, (1, 1)), (32, (5, 3)), (96, (17, 16)), (192, (3, 2))])
def test_kernels_are_the_operators(channels, size, modulated):
    tensors = inputs(channels, size, modulated)
    expected, gradients = run(reference, tensors, torch.float64)
    out, found = run(fused, tensors, torch.float32)
    assert out.is_contiguous(memory_format=torch.channels_last)
    torch.testing.assert_close(out.double(), expected, atol=2e-4, rtol=1e-4)
    for one, other in zip(found, gradients, strict=True):
        torch.testing.assert_close(one.double(), other, atol=2e-3, rtol=1e-3)


def test_numbers_far_from_zero_keep_their_variance():
    tensors = inputs(64, (4, 4), False, mean=1000.0)
    expected, _ = run(reference, tensors, torch.float64)
    torch.testing.assert_close(run(fused, tensors, torch.float32)[0].double(), expected, atol=2e-3, rtol=1e-3)


def test_output_is_of_the_type_that_autocast_rounds_to():
    x, *_ = inputs(32, (2, 2), False)
    norm, x = nn.GroupNorm(32, 32, device=DEVICE), x.float().to(DEVICE)
    with torch.autocast(DEVICE, torch.bfloat16):
        out = fused(norm, x)
    assert out.dtype == torch.bfloat16
    torch.testing.assert_close(out.float(), reference(norm, x), atol=2e-2, rtol=1e-2)
    assert fused(norm.bfloat16(), x.bfloat16()).dtype == torch.bfloat16


def test_where_kernels_fail_the_operators_take_over_with_one_line(monkeypatch, caplog):
    def fail(*_):
        raise RuntimeError("no such device\nand more")

    monkeypatch.setattr(module, "_told", set())
    monkeypatch.setattr(module, "_fusible", lambda x: True)
    monkeypatch.setattr(module, "fused", fail)
    caplog.set_level(logging.WARNING, logger=module.__name__)
    norm, x = nn.GroupNorm(32, 32), torch.randn(1, 32, 2, 2)
    for _ in range(2):
        assert torch.equal(norm_silu(norm, x), reference(norm, x))
    (line,) = caplog.messages
    assert "operators take over (RuntimeError: no such device)" in line


@pytest.mark.skipif(DEVICE == "cuda", reason="there the kernels are right")
def test_on_a_cpu_the_operators_are_used(monkeypatch):
    monkeypatch.setattr(module, "fused", None)
    norm, x = nn.GroupNorm(32, 32), torch.randn(1, 32, 2, 2).to(memory_format=torch.channels_last)
    assert torch.equal(norm_silu(norm, x), reference(norm, x))
