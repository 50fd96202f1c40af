"""The memory layout of the U-Nets, in training and evaluation."""

import torch

from nerfdiff.diffusion.norm_silu import kernels_run
from nerfdiff.utils.errors import ConfigError


def channels_last(choice: object, device: torch.device, compiled: bool) -> bool:
    """Return true for channels_last: images are stored pixel by pixel, not channel by channel.

    Convolutions of a CPU and compiled U-Nets want them so. On a GPU, eager, it takes the fused norms: PyTorch's own
    turn each image back.

    Args:
        choice: a person's, `true` or `false`; None leaves it to this rule.
        device: where the U-Nets run.
        compiled: whether `torch.compile` takes them.

    Raises:
        ConfigError: another choice.
    """
    if isinstance(choice, bool):
        return choice
    if choice is not None:
        raise ConfigError(f"channels_last takes true, false or null, got {choice!r}")
    return device.type == "cpu" or compiled or kernels_run(device)
