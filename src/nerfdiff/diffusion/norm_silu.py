"""GroupNorm, the time embedding's scale and shift, and SiLU: as PyTorch's operators, or on a GPU in one go.

One by one they read and write the image as often as the convolutions around them, and PyTorch's GroupNorm on a GPU
leaves channels_last, so that what follows has to turn the image round again. The kernels keep it, and so do their
gradients.
"""

import logging
from functools import cache, partial

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

log = logging.getLogger(__name__)

Features = Float[Tensor, "batch channels height width"]
Modulation = Float[Tensor, "batch 2*channels"]

_warned: set[str] = set()


def norm_silu(norm: nn.GroupNorm, x: Features, scale_shift: Modulation | None = None) -> Features:
    """Return SiLU(norm(x) · (1 + scale) + shift).

    Fused for images in channels_last on a GPU, unless a compiler fuses all that is around it too. Where kernels fail,
    one line says why, and the operators take over.

    Args:
        scale_shift: scale and then shift of every channel; None: neither.
    """
    return _either(norm, x, scale_shift, True)


def group_norm(norm: nn.GroupNorm, x: Features) -> Features:
    """Return norm(x), by the same choice as `norm_silu`."""
    return _either(norm, x, None, False)


def reference(norm: nn.GroupNorm, x: Features, scale_shift: Modulation | None = None, active: bool = True) -> Features:
    """Compute `norm_silu`, or without SiLU where not active, in PyTorch's operators."""
    return _after_norm(norm(x), scale_shift, active)


def fused(norm: nn.GroupNorm, x: Features, scale_shift: Modulation | None = None, active: bool = True) -> Features:
    """Compute `reference` by kernels in fp32, and round to the type of the next product."""
    from nerfdiff.diffusion.kernels.function import Settings, fused_norm

    device = x.device.type
    dtype = torch.get_autocast_dtype(device) if torch.is_autocast_enabled(device) else x.dtype
    settings = Settings(norm.num_groups, norm.eps, active)
    return fused_norm(settings, dtype, partial(_recover, settings), x, norm.weight, norm.bias, scale_shift)


@cache
def kernels_run(device: torch.device) -> bool:
    """Return true if there are kernels for a device: a GPU of compute capability 8.0 or newer, with Triton."""
    return device.type == "cuda" and torch.cuda.get_device_capability(device) >= (8, 0) and _importable()


def _either(norm: nn.GroupNorm, x: Features, scale_shift: Modulation | None, active: bool) -> Features:
    if torch.compiler.is_compiling() or not _fusible(x):
        return reference(norm, x, scale_shift, active)
    try:
        return fused(norm, x, scale_shift, active)
    except torch.OutOfMemoryError:
        raise
    except Exception as error:
        _give_up(error)
        return reference(norm, x, scale_shift, active)


def _after_norm(h: Features, scale_shift: Modulation | None, active: bool) -> Features:
    if scale_shift is not None:
        scale, shift = scale_shift[:, :, None, None].chunk(2, dim=1)
        h = h * (1 + scale) + shift
    return F.silu(h) if active else h


def _fusible(x: Tensor) -> bool:
    """Return true if the kernels suit these images."""
    if _warned or not kernels_run(x.device):
        return False
    laid_out = x.is_contiguous(memory_format=torch.channels_last) and not x.is_contiguous()
    return laid_out and x.dtype in (torch.float32, torch.bfloat16, torch.float16) and x.numel() > 0


def _importable() -> bool:
    try:
        import nerfdiff.diffusion.kernels.function  # noqa: F401
    except ImportError:
        return False
    return True


def _recover(settings, error: Exception, tensors, gradient: Tensor, needed) -> list[Tensor | None]:
    """Compute the gradients of the kernels' output by the operators, in fp32."""
    _give_up(error)
    leaves = [None if t is None else t.detach().requires_grad_(need) for t, need in zip(tensors, needed, strict=True)]
    with torch.enable_grad(), torch.autocast(gradient.device.type, enabled=False):
        x, weight, bias, scale_shift = (None if leaf is None else leaf.float() for leaf in leaves)
        normalized = F.group_norm(x, settings.groups, weight, bias, settings.eps)
        out = _after_norm(normalized, scale_shift, settings.active)
    wanted = [leaf for leaf, need in zip(leaves, needed, strict=True) if need]
    found = iter(torch.autograd.grad(out, wanted, gradient.to(out.dtype)))
    return [next(found) if need else None for need in needed]


def _give_up(error: Exception) -> None:
    lines = str(error).strip().splitlines()
    reason = f"{type(error).__name__}: {lines[0] if lines else 'no message'}"
    if reason not in _warned:
        _warned.add(reason)
        log.warning("no fused GroupNorm and SiLU, PyTorch's operators take over (%s)", reason)
