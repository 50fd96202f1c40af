"""Where bf16 must not go: coordinates, compositing, camera algebra."""

import torch
from torch import Tensor


def full_precision(device: torch.device):
    """A context that keeps matrix products out of autocast."""
    return torch.autocast(device.type, enabled=False)


def at_least_single(tensor: Tensor) -> Tensor:
    """fp32, or float64 where the input is (references and gradient checks run in float64)."""
    return tensor if tensor.dtype == torch.float64 else tensor.float()
