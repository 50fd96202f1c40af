"""What a training step will take, found out on the meta device before anything is allocated."""

import logging
from collections.abc import Mapping
from dataclasses import dataclass

import psutil
import torch
import torch.nn.functional as F
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves
from torch.utils.weak import WeakIdKeyDictionary

from nerfdiff.cameras import Cameras
from nerfdiff.errors import ConfigError
from nerfdiff.model import build_on_meta

log = logging.getLogger(__name__)

WEIGHTS_ADAM_EMA = 4 * 4
"""Bytes per parameter that stay: fp32 weights, Adam's two moments, the average."""


class PeakMemory(TorchDispatchMode):
    """Counts the bytes of all tensors made inside that are alive at once.

    Works on the meta device, where nothing is allocated; memory that an operator takes while it runs (cuDNN's and
    attention's workspaces) is not seen.
    """

    def __init__(self):
        super().__init__()
        self.live = self.peak = 0
        self._known = WeakIdKeyDictionary()

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        out = func(*args, **(kwargs or {}))
        for tensor in tree_leaves(out):
            if isinstance(tensor, torch.Tensor):
                self._count(tensor.untyped_storage())
        return out

    def _count(self, storage: torch.UntypedStorage) -> None:
        if storage in self._known:
            return
        self._known[storage] = _Alive(self, storage.nbytes())


class _Alive:
    """Lives as long as its storage does."""

    def __init__(self, tracker: PeakMemory, size: int):
        self.tracker, self.size = tracker, size
        tracker.live += size
        tracker.peak = max(tracker.peak, tracker.live)

    def __del__(self):
        self.tracker.live -= self.size


@dataclass(frozen=True)
class TrainingMemory:
    """Bytes of one training process.

    Args:
        state: weights, Adam's moments and the average, in fp32.
        step: the most that one forward and backward pass holds beside, gradients included, in fp32. Under bf16
            autocast the U-Nets' share of it is about half.
    """

    state: int
    step: int

    @property
    def total(self) -> int:
        return self.state + self.step


def training_memory(
    model_config: Mapping, batch_size: int, target_views: int, height: int, width: int
) -> TrainingMemory:
    """Trace a training step of the joint loss on the meta device: it takes time (thousands of operators) and no memory.

    Args:
        model_config: arguments of `NerfDiff`.
        batch_size: draws that pass through the device at once.
    """
    model = build_on_meta(model_config)
    parameters = sum(p.numel() for p in model.parameters())
    with PeakMemory() as tracker, torch.device("meta"):
        source = torch.empty(batch_size, 3, height, width)
        targets = torch.empty(batch_size * target_views, 3, height, width)
        bounds = torch.empty(batch_size)
        cameras = Cameras(torch.empty(batch_size, 4, 4), torch.empty(batch_size, 3, 3), height, width)
        c2w, K = (m[:, None].repeat(1, target_views, 1, 1) for m in (cameras.c2w, cameras.K))
        views = Cameras(c2w, K, height, width)
        jitter = torch.empty(batch_size, target_views * height * width, model.renderer.samples_per_ray)

        encoding = model.encode(source, cameras, bounds, bounds)
        rendering = model.render(encoding, views, jitter)
        condition = model.condition(encoding, views, rendering)
        velocity = model.denoiser.velocity(targets, targets.new_empty(len(targets)), condition)
        (F.mse_loss(condition.rendered, targets) + F.mse_loss(velocity, targets)).backward()
    return TrainingMemory(WEIGHTS_ADAM_EMA * parameters, tracker.peak)


def is_tight(model_config: Mapping, device: torch.device) -> bool:
    """Whether the state alone takes a quarter of what is free, so that a step is worth tracing."""
    parameters = sum(p.numel() for p in build_on_meta(model_config).parameters())
    return 4 * WEIGHTS_ADAM_EMA * parameters >= free_memory(device)


def require_memory(
    model_config: Mapping, device: torch.device, batch_size: int, target_views: int, height: int, width: int
) -> None:
    """Refuse a run that the device cannot hold before hours or the machine are lost to it.

    Raises:
        ConfigError: it takes more than is free on `device`; the message says how much, for what, and what takes less.
    """
    free = free_memory(device)
    needed = training_memory(model_config, batch_size, target_views, height, width)
    state, step, available = (amount / 2**30 for amount in (needed.state, needed.step, free))
    told = (
        f"training takes about {state + step:.1f} GiB: {state:.1f} of weights, Adam and EMA, and in fp32 {step:.1f} "
        f"of gradients and activations for {batch_size} x {height}x{width} at once; {device.type} has "
        f"{available:.1f} GiB free"
    )
    if needed.total > free:
        raise ConfigError(
            f"{told}. Choose a smaller model or more memory; trainer.accumulate_grad_batches=N passes the batch "
            "through in N parts, model.unet.checkpointing=true and a smaller model.render.chunk recompute more and "
            "keep less"
        )
    log.info("%s", told)


def free_memory(device: torch.device) -> int:
    """Bytes that a new process could take on `device` now."""
    return torch.cuda.mem_get_info(device)[0] if device.type == "cuda" else psutil.virtual_memory().available
