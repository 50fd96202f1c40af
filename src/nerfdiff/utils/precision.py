"""Contexts that keep bf16 out of coordinates, compositing, camera algebra."""

from contextlib import AbstractContextManager, nullcontext

import torch
from torch import Tensor


def full_precision(device: torch.device) -> AbstractContextManager:
    """A context that keeps matrix products out of autocast."""
    # the meta device computes nothing, and knows no autocast
    return nullcontext() if device.type == "meta" else torch.autocast(device.type, enabled=False)


def at_least_single(tensor: Tensor) -> Tensor:
    """fp32, or float64 where the input is (references and gradient checks run in float64)."""
    return tensor if tensor.dtype == torch.float64 else tensor.float()
