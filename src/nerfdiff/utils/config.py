"""From values of a config to what other code takes."""

from collections.abc import Callable
from dataclasses import fields
from functools import wraps
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


def from_keys(**groups: type) -> Callable[[type], type]:
    """Decorate a class that takes settings whole, so that it can be built from their keys one by one, as in `conf/`.

    A config stays flat that way: `Distillation(…, rays=4096, lr_planes=0.05, …)` is
    `Distillation(…, fit=FitSettings(rays=4096, lr_planes=0.05, …))`.

    Args:
        groups: frozen dataclasses, by the names of the arguments that take them.
    """

    def decorate(cls: type) -> type:
        plain_init = cls.__init__

        @wraps(plain_init)
        def init(self, *args, **keys):
            for name, settings in groups.items():
                own = {field.name: keys.pop(field.name) for field in fields(settings) if field.name in keys}
                keys |= {name: settings(**own)} if own else {}
            plain_init(self, *args, **keys)

        cls.__init__ = init
        return cls

    return decorate
