"""GroupNorm, the time embedding's scale and shift, and SiLU: as PyTorch's operators, or on a GPU in one go.

One by one they read and write the image as often as the convolutions around them, and PyTorch's GroupNorm on a GPU
leaves channels_last, so that the next convolution has to turn the image round again. The kernels keep it.
"""

import logging
from functools import cache

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

log = logging.getLogger(__name__)

Features = Float[Tensor, "batch channels height width"]
Modulation = Float[Tensor, "batch 2*channels"]

_TILE = 4096
"""Numbers that a program holds at once."""
_PIXELS = 256
"""Pixels of an image that one program sums up, at least."""

_told: set[str] = set()


def norm_silu(norm: nn.GroupNorm, x: Features, scale_shift: Modulation | None = None) -> Features:
    """SiLU(norm(x) · (1 + scale) + shift).

    Fused for images in channels_last on a GPU, unless a compiler fuses all that is around it too. Where kernels fail,
    one line says why, and the operators take over.

    Args:
        scale_shift: scale and then shift of every channel; None: neither.
    """
    if torch.compiler.is_compiling() or not _fusible(x):
        return reference(norm, x, scale_shift)
    try:
        return fused(norm, x, scale_shift)
    except torch.OutOfMemoryError:
        raise
    except Exception as error:
        _give_up(error)
        return reference(norm, x, scale_shift)


def reference(norm: nn.GroupNorm, x: Features, scale_shift: Modulation | None = None) -> Features:
    """`norm_silu` in PyTorch's operators."""
    return _modulated(norm(x), scale_shift)


def _modulated(h: Features, scale_shift: Modulation | None) -> Features:
    if scale_shift is not None:
        scale, shift = scale_shift[:, :, None, None].chunk(2, dim=1)
        h = h * (1 + scale) + shift
    return F.silu(h)


def fused(norm: nn.GroupNorm, x: Features, scale_shift: Modulation | None = None) -> Features:
    """`norm_silu` in kernels, computed in fp32, in the type that the next convolution would round it to."""
    device = x.device.type
    autocast = torch.is_autocast_enabled(device)
    dtype = torch.get_autocast_dtype(device) if autocast else x.dtype
    with torch.autocast(device, enabled=False):
        return _NormSiLU.apply(x, norm.weight, norm.bias, scale_shift, norm.num_groups, norm.eps, dtype)


class _NormSiLU(torch.autograd.Function):
    """Keeps the input alone; the backward pass makes the rest again, operator by operator."""

    @staticmethod
    def forward(ctx, x, weight, bias, scale_shift, groups, eps, dtype):
        ctx.save_for_backward(x, weight, bias, scale_shift)
        ctx.groups, ctx.eps = groups, eps
        return _launch(x, weight, bias, scale_shift, groups, eps, dtype)

    @staticmethod
    def backward(ctx, gradient):
        inputs = [None if t is None else t.detach().requires_grad_(n) for t, n in _with_needs(ctx)]
        with torch.enable_grad(), torch.autocast(gradient.device.type, enabled=False):
            x, weight, bias, scale_shift = (None if t is None else t.float() for t in inputs)
            out = _modulated(F.group_norm(x, ctx.groups, weight, bias, ctx.eps), scale_shift)
        wanted = [t for t in inputs if t is not None and t.requires_grad]
        found = iter(torch.autograd.grad(out, wanted, gradient.to(out.dtype)))
        return *(next(found) if t is not None and t.requires_grad else None for t in inputs), None, None, None


def _with_needs(ctx) -> list[tuple[Tensor | None, bool]]:
    return list(zip(ctx.saved_tensors, ctx.needs_input_grad[:4], strict=True))


def _launch(x, weight, bias, scale_shift, groups: int, eps: float, dtype: torch.dtype) -> Tensor:
    import triton

    from nerfdiff.diffusion.kernels.norm_silu import apply_kernel, coefficients_kernel, sums_kernel

    images, channels, height, width = x.shape
    pixels, padded = height * width, triton.next_power_of_2(channels)
    rows = max(1, _TILE // padded)
    steps = triton.cdiv(min(_PIXELS, pixels), rows)
    parts = triton.cdiv(pixels, steps * rows)
    x = x.contiguous(memory_format=torch.channels_last)
    sums = x.new_empty(images, parts, 2, channels, dtype=torch.float32)
    coefficients = x.new_empty(images, 2, channels, dtype=torch.float32)
    out = torch.empty_like(x, dtype=dtype)
    modulation = x if scale_shift is None else scale_shift.contiguous()
    size = channels // groups
    with torch.cuda.device_of(x):
        sums_kernel[(images, parts)](x, sums, pixels, C=channels, CP=padded, R=rows, STEPS=steps)
        coefficients_kernel[(images,)](
            x, sums, weight, bias, modulation, coefficients, pixels, parts, eps,
            MODULATED=scale_shift is not None, GROUPS=groups, SIZE=size, SP=triton.next_power_of_2(size),
        )  # fmt: skip
        apply_kernel[(images, triton.cdiv(pixels, rows))](x, coefficients, out, pixels, C=channels, CP=padded, R=rows)
    return out


def _fusible(x: Tensor) -> bool:
    """Whether the kernels are right for these images."""
    laid_out = x.is_contiguous(memory_format=torch.channels_last) and not x.is_contiguous()
    known = x.dtype in (torch.float32, torch.bfloat16, torch.float16)
    return x.is_cuda and laid_out and known and x.numel() > 0 and not _told and _importable()


@cache
def _importable() -> bool:
    try:
        import nerfdiff.diffusion.kernels.norm_silu  # noqa: F401
    except ImportError:
        return False
    return True


def _give_up(error: Exception) -> None:
    lines = str(error).strip().splitlines()
    reason = f"{type(error).__name__}: {lines[0] if lines else 'no message'}"
    if reason not in _told:
        _told.add(reason)
        log.warning("no fused GroupNorm and SiLU, PyTorch's operators take over (%s)", reason)
