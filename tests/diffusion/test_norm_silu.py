"""The kernels, in Triton's interpreter where there is no GPU, against PyTorch's operators in float64."""

import logging

import pytest
import torch
from torch import Tensor, nn
from torch.utils._python_dispatch import TorchDispatchMode

from model_fixtures import config
from nerfdiff.diffusion import norm_silu as module
from nerfdiff.diffusion.blocks import Attention
from nerfdiff.diffusion.norm_silu import fused, group_norm, kernels_run, norm_silu, reference
from nerfdiff.diffusion.unet import UNet

pytest.importorskip("triton")
from nerfdiff.diffusion.kernels import function

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"
LAST = torch.channels_last
HALF = 2**-7 if DEVICE == "cpu" else 2**-8
"""Relative error of bf16: the interpreter cuts off what a GPU rounds."""
SIZES = [(32, (1, 1)), (32, (5, 3)), (96, (5, 3)), (160, (3, 1)), (192, (3, 3))]
MODULATED_ACTIVE = [(False, False), (False, True), (True, False), (True, True)]


@pytest.fixture(autouse=True)
def poisoned():
    """New memory holds NaN: what no program writes shows."""
    torch.use_deterministic_algorithms(True)
    assert torch.empty(3).isnan().all()
    yield
    torch.use_deterministic_algorithms(False)


def inputs(channels: int, size: tuple[int, int], modulated: bool, mean: float = 0.0, half: bool = False):
    """x, weight, bias and scale_shift; where half, images and modulation in bf16, as autocast brings them."""
    noise = torch.Generator().manual_seed(channels + size[0] + 2 * modulated)
    dtype = torch.bfloat16 if half else torch.float32

    def numbers(*shape, mean=0.0):
        return (mean + torch.randn(*shape, generator=noise)).to(DEVICE)

    x = numbers(2, channels, *size, mean=mean).to(dtype, memory_format=LAST)
    scale_shift = numbers(2, 2 * channels).to(dtype) if modulated else None
    return [x, numbers(channels), numbers(channels), scale_shift]


def differentiate(how, tensors, active: bool, gradient: Tensor | None = None, double: bool = False):
    """Output and gradients of all inputs, of an output's gradient that by default weights each number differently."""
    leaves = [t if t is None else t.detach().to(torch.float64 if double else t.dtype) for t in tensors]
    leaves = [t if t is None else t.requires_grad_() for t in leaves]
    x, weight, bias, scale_shift = leaves
    norm = nn.GroupNorm(32, len(weight))
    norm.weight, norm.bias = (nn.Parameter(value) for value in (weight, bias))
    with torch.autocast(DEVICE, torch.bfloat16, enabled=x.dtype == torch.bfloat16):
        out = how(norm, x, scale_shift, active)
    if gradient is None:
        gradient = torch.linspace(-1, 1, out.numel(), device=DEVICE).reshape(out.shape)
    wanted = [t for t in (x, norm.weight, norm.bias, scale_shift) if t is not None]
    return out.detach(), list(torch.autograd.grad(out, wanted, gradient.to(out.dtype)))


def assert_near(found: Tensor, expected: Tensor, tolerance: float) -> None:
    torch.testing.assert_close(found.double(), expected, atol=tolerance * (1 + expected.abs().max()), rtol=0)


@pytest.mark.parametrize(("modulated", "active"), MODULATED_ACTIVE)
@pytest.mark.parametrize(("channels", "size"), SIZES)
def test_kernels_are_the_operators(channels, size, modulated, active, monkeypatch):
    if size == (5, 3):  # as large images are divided, with pieces left over
        monkeypatch.setattr(function, "_TILE", 512)
        monkeypatch.setattr(function, "_PIXELS", 7)
    tensors = inputs(channels, size, modulated)
    expected, gradients = differentiate(reference, tensors, active, double=True)
    out, found = differentiate(fused, tensors, active)
    assert_near(out, expected, 1e-5)
    for one, other in zip(found, gradients, strict=True):
        assert_near(one, other, 1e-4)
    assert out.is_contiguous(memory_format=LAST) and found[0].is_contiguous(memory_format=LAST)


@pytest.mark.parametrize(("modulated", "active"), MODULATED_ACTIVE)
def test_halves_are_rounded_once(modulated, active):
    """To what autocast's next product takes, and gradients to what they belong to."""
    tensors = inputs(96, (5, 3), modulated, half=True)
    gradient = torch.randn(2, 96, 5, 3, device=DEVICE).bfloat16()
    expected, gradients = differentiate(reference, tensors, active, gradient, double=True)
    out, found = differentiate(fused, tensors, active, gradient)
    assert out.dtype == torch.bfloat16 and out.is_contiguous(memory_format=LAST)
    torch.testing.assert_close(out.double(), expected, atol=1e-4, rtol=HALF)
    for one, other, tensor in zip(found, gradients, [t for t in tensors if t is not None], strict=True):
        assert one.dtype == tensor.dtype
        torch.testing.assert_close(one.double(), other, atol=1e-4, rtol=HALF if one.dtype == torch.bfloat16 else 1e-4)


@pytest.mark.parametrize("half", [False, True])
def test_numbers_far_from_zero_keep_their_variance(half):
    tensors = inputs(96, (5, 3), True, mean=1000.0, half=half)
    gradient = torch.randn(2, 96, 5, 3, device=DEVICE).bfloat16()
    expected, gradients = differentiate(reference, tensors, True, gradient, double=True)
    out, found = differentiate(fused, tensors, True, gradient)
    for one, other in zip([out, *found], [expected, *gradients], strict=True):
        assert_near(one, other, HALF if half else 5e-4)


@pytest.mark.parametrize("layout", ["channels_first", "expanded", "part"])
def test_gradients_come_in_any_layout(layout):
    tensors = inputs(32, (5, 3), True)
    whole = torch.randn(2, 64, 5, 3, device=DEVICE)
    gradient = {
        "channels_first": whole[:, :32].contiguous(),
        "expanded": whole[:1, :1, :1, :1].expand(2, 32, 5, 3),
        "part": whole[:, ::2],
    }[layout]
    assert not gradient.is_contiguous(memory_format=LAST)
    _, expected = differentiate(fused, tensors, True, gradient.contiguous(memory_format=LAST))
    _, found = differentiate(fused, tensors, True, gradient)
    assert all(torch.equal(one, other) for one, other in zip(found, expected, strict=True))
    assert found[0].is_contiguous(memory_format=LAST)


@pytest.mark.parametrize("only", range(4))
def test_a_gradient_that_nobody_needs_is_not_computed(only, monkeypatch):
    tensors, made, launched = inputs(32, (5, 3), True), [], []
    gradients, apply = function._gradients, function.gradient_apply_kernel
    gradient = torch.randn(2, 32, 5, 3, device=DEVICE)
    _, expected = differentiate(fused, tensors, True, gradient)

    class Watched:
        def __getitem__(self, grid):
            launched.append(grid)
            return apply[grid]

    def watched(*arguments):
        made.append(gradients(*arguments))
        return made[-1]

    monkeypatch.setattr(function, "_gradients", watched)
    monkeypatch.setattr(function, "gradient_apply_kernel", Watched())
    leaves = [tensor.requires_grad_(index == only) for index, tensor in enumerate(tensors)]
    norm = nn.GroupNorm(32, 32)
    norm.weight, norm.bias = (nn.Parameter(leaf, requires_grad=leaf.requires_grad) for leaf in leaves[1:3])
    wanted = [leaves[0], norm.weight, norm.bias, leaves[3]][only]
    (found,) = torch.autograd.grad(fused(norm, leaves[0], leaves[3]), wanted, gradient)
    assert torch.equal(found, expected[only])
    assert [one is not None for one in made[0]] == [index == only for index in range(4)]
    assert len(launched) == (only == 0)


def test_four_numbers_per_channel_are_kept_beside_the_inputs():
    x, *_, scale_shift = inputs(32, (5, 3), True)
    norm, kept = nn.GroupNorm(32, 32, device=DEVICE), []
    with torch.autograd.graph.saved_tensors_hooks(lambda tensor: kept.append(tensor.numel()) or tensor, lambda t: t):
        fused(norm, x.requires_grad_(), scale_shift)
    assert sorted(kept) == sorted([x.numel(), 32, 32, scale_shift.numel(), 2 * 4 * 32])


def test_output_is_of_the_inputs_type_without_autocast():
    x, *_ = inputs(32, (2, 2), False, half=True)
    assert fused(nn.GroupNorm(32, 32, device=DEVICE), x).dtype == torch.bfloat16
    with torch.autocast(DEVICE, torch.bfloat16):
        assert fused(nn.GroupNorm(32, 32, device=DEVICE), x.float()).dtype == torch.bfloat16


def test_unets_in_channels_last_may_take_the_kernels_at_every_norm(monkeypatch):
    """Attention's included: nothing on the way leaves the layout."""
    sizes = config()["unet"]
    encoder = UNet(3, 3, **sizes, with_time=False, cross_attention=False, zero_output=False)
    net = UNet(3, 3, **sizes, with_time=True, cross_attention=True, zero_output=False)
    both = nn.ModuleList([encoder, net]).to(DEVICE, memory_format=LAST)
    taken = []

    def stand_in(norm, *rest):
        taken.append(norm)
        return reference(norm, *rest).contiguous(memory_format=LAST)

    monkeypatch.setattr(module, "kernels_run", lambda device: True)
    monkeypatch.setattr(module, "fused", stand_in)
    _, features = encoder(torch.randn(1, 3, 6, 10, device=DEVICE))
    net(torch.randn(2, 3, 6, 10, device=DEVICE), torch.rand(2, device=DEVICE), features)
    assert sorted(map(id, taken)) == sorted(id(part) for part in both.modules() if isinstance(part, nn.GroupNorm))


def test_attention_by_kernels_is_that_by_operators_and_copies_nothing(monkeypatch):
    layer = Attention(64, 32, True).to(DEVICE)
    nn.init.normal_(layer.out.weight)
    x, context = (torch.randn(1, 64, 3, 2, device=DEVICE).to(memory_format=LAST).requires_grad_() for _ in range(2))
    wanted = [x, context, *layer.parameters()]

    def run():
        out = layer(x, context)
        return [out.detach(), *torch.autograd.grad(out.square().sum(), wanted)]

    expected = run()
    monkeypatch.setattr(module, "kernels_run", lambda device: True)
    monkeypatch.setattr(module, "reference", None)
    for one, other in zip(run(), expected, strict=True):
        torch.testing.assert_close(one, other, atol=1e-3, rtol=1e-4)

    normalized = fused(layer.norm, x, None, False).detach()
    monkeypatch.setattr(module, "fused", lambda *_: normalized)
    with Operators() as seen, torch.no_grad():
        layer(x, context)
    assert "mm" in seen.names or "addmm" in seen.names
    assert not {"clone", "copy_", "_to_copy"} & seen.names


class Operators(TorchDispatchMode):
    """The names of all that ran."""

    def __init__(self):
        super().__init__()
        self.names = set()

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        self.names.add(func.overloadpacket.__name__)
        return func(*args, **(kwargs or {}))


def test_where_kernels_fail_the_operators_take_over_with_one_line(monkeypatch, caplog):
    def fail(*_):
        raise RuntimeError("no such device\nand more")

    monkeypatch.setattr(module, "_warned", set())
    monkeypatch.setattr(module, "_fusible", lambda x: True)
    monkeypatch.setattr(module, "fused", fail)
    caplog.set_level(logging.WARNING, logger=module.__name__)
    norm, x = nn.GroupNorm(32, 32), torch.randn(1, 32, 2, 2)
    for _ in range(2):
        assert torch.equal(norm_silu(norm, x), reference(norm, x))
        assert torch.equal(group_norm(norm, x), norm(x))
    (line,) = caplog.messages
    assert "operators take over (RuntimeError: no such device)" in line


@pytest.mark.parametrize("modulated", [False, True])
def test_where_the_backward_pass_fails_the_operators_take_over_with_one_line(modulated, monkeypatch, caplog):
    def fail(*_):
        raise RuntimeError("out of registers\nand more")

    tensors = inputs(32, (5, 3), modulated)
    _, expected = differentiate(reference, tensors, True)
    monkeypatch.setattr(module, "_warned", set())
    monkeypatch.setattr(function, "_gradients", fail)
    caplog.set_level(logging.WARNING, logger=module.__name__)
    _, found = differentiate(fused, tensors, True)
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one, other, atol=1e-4, rtol=1e-4)
    (line,) = caplog.messages
    assert "operators take over (RuntimeError: out of registers)" in line
    assert not module._fusible(tensors[0])


@pytest.mark.skipif(DEVICE == "cuda", reason="there the kernels are right")
def test_on_a_cpu_the_operators_are_used(monkeypatch):
    monkeypatch.setattr(module, "fused", None)
    norm, x = nn.GroupNorm(32, 32), torch.randn(1, 32, 2, 2).to(memory_format=LAST)
    assert torch.equal(norm_silu(norm, x), reference(norm, x))
    assert torch.equal(group_norm(norm, x), norm(x))


@pytest.mark.parametrize(("capability", "there"), [((7, 5), False), ((8, 0), True), ((9, 0), True)])
def test_kernels_are_for_ampere_and_newer(capability, there, monkeypatch):
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda device: capability)
    assert kernels_run.__wrapped__(torch.device("cuda", 0)) == there
    assert not kernels_run.__wrapped__(torch.device("cpu"))
    monkeypatch.setattr(module, "_importable", lambda: False)
    assert not kernels_run.__wrapped__(torch.device("cuda", 0))
