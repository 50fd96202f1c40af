"""From values of a config to what other code takes."""

from typing import Any

import torch
from omegaconf import OmegaConf


def auto_precision(accelerator: str) -> str:
    """`bf16-mixed` where a GPU will be used that computes in bf16, else `32-true`."""
    on_gpu = accelerator in ("auto", "gpu", "cuda") and torch.cuda.is_available()
    return "bf16-mixed" if on_gpu and torch.cuda.is_bf16_supported(including_emulation=False) else "32-true"


def plain(node: Any) -> Any:
    """A config node as dicts and lists, interpolations resolved: what a checkpoint can hold."""
    return OmegaConf.to_container(node, resolve=True)
