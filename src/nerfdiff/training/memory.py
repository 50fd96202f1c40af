"""The memory of a training step, traced on the meta device before anything is allocated."""

import gc
import logging
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves
from torch.utils.weak import WeakIdKeyDictionary

from nerfdiff.cameras import Cameras
from nerfdiff.diffusion.unet import AUTO
from nerfdiff.model import NerfDiff, build_on_meta
from nerfdiff.utils.errors import ConfigError
from nerfdiff.utils.memory import free_memory

log = logging.getLogger(__name__)

WEIGHTS_ADAM_EMA = 4 * 4
"""Bytes per parameter that stay: fp32 weights, Adam's two moments, the average."""
HEADROOM = 0.85
"""Share of the free memory that `checkpointing=auto` plans with: recomputing more is better than running out."""


class PeakMemory(TorchDispatchMode):
    """Counts the bytes of all tensors made inside that are alive at once.

    Works on the meta device, where nothing is allocated; memory that an operator takes while it runs (cuDNN's and
    attention's workspaces) is not counted.
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


@contextmanager
def like_a_gpu(mixed: bool) -> Iterator[None]:
    """Make the meta device act as a GPU: attention that keeps no weights, and bf16 under autocast.

    The meta device has neither. What counts is which operators keep a copy in which type: as in autocast's lists,
    products take bf16, GroupNorm takes fp32, and a parameter is cast once for all. The functions themselves are
    exchanged, as a TorchFunctionMode rests during the backward pass, where checkpointing needs it.
    """
    cast: dict[int, torch.Tensor] = {}

    def half(value):
        if not mixed or not isinstance(value, torch.Tensor):
            return value
        if not (value.is_leaf and value.requires_grad):
            return value.to(torch.bfloat16)
        if id(value) not in cast:
            cast[id(value)] = value.to(torch.bfloat16)
        return cast[id(value)]

    def product(function):
        return lambda *args: function(*map(half, args))

    def normalize(x, *settings, **named):
        return plain["group_norm"](x.float() if mixed else x, *settings, **named)

    def attend(*args):
        return torch.ops.aten._scaled_dot_product_flash_attention_for_cpu(*map(half, args))[0]

    plain = {name: getattr(F, name) for name in ("conv2d", "linear", "group_norm", "scaled_dot_product_attention")}
    instead = {
        "conv2d": product(plain["conv2d"]),
        "linear": product(plain["linear"]),
        "group_norm": normalize,
        "scaled_dot_product_attention": attend,
    }
    try:
        for name, function in instead.items():
            setattr(F, name, function)
        yield
    finally:
        for name, function in plain.items():
            setattr(F, name, function)


@contextmanager
def no_garbage_collection() -> Iterator[None]:
    """Make traces repeatable, and the largest possible: checkpointing leaves cycles that hold tensors, and which of
    them Python collects in time depends on all that ran before.
    """
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


@dataclass(frozen=True)
class TrainingMemory:
    """Bytes of one training process.

    Args:
        state: weights, Adam's moments and the average, in fp32.
        step: the most that one forward and backward pass holds beside, gradients included.
    """

    state: int
    step: int

    @property
    def total(self) -> int:
        return self.state + self.step


def training_memory(
    model_config: Mapping, batch_size: int, target_views: int, height: int, width: int, precision: str
) -> TrainingMemory:
    """Trace a training step of the joint loss on the meta device: it takes time (thousands of operators) and no memory.

    The U-Nets are eager and the renderer is the reference; what is compiled or fused keeps less.

    Args:
        model_config: arguments of `NerfDiff`.
        batch_size: draws that pass through the device at once.
        precision: the trainer's, `32-true` or `bf16-mixed`.
    """
    model = build_on_meta(model_config)
    parameters = sum(p.numel() for p in model.parameters())
    with no_garbage_collection(), PeakMemory() as tracker, torch.device("meta"), like_a_gpu(precision == "bf16-mixed"):
        _step(model, batch_size, target_views, height, width)
    return TrainingMemory(WEIGHTS_ADAM_EMA * parameters, tracker.peak)


def largest_batch(
    model_config: Mapping, memory: int, target_views: int, height: int, width: int, precision: str
) -> int:
    """Return how many draws pass through a device of so many bytes at once; 0 where not even one fits.

    Args:
        model_config, target_views, height, width, precision: as for `training_memory`.
    """

    totals: dict[int, int] = {}

    def total(batch: int) -> int:
        if batch not in totals:
            totals[batch] = training_memory(model_config, batch, target_views, height, width, precision).total
        return totals[batch]

    def line(one: int, other: int) -> int:
        """Return where the straight line through two batches reaches the memory."""
        per_draw = max(1, (total(other) - total(one)) // (other - one))
        return one + (memory - total(one)) // per_draw

    if total(1) > memory:
        return 0
    # Different moments hold the most in small and in large batches, each growing in a line: the whole is bent upwards.
    fits, too_many = 1, 2
    while total(too_many) <= memory:
        fits, too_many = too_many, max(too_many, line(fits, too_many)) + 1
    while too_many - fits > 1:
        guess = min(max(line(fits, too_many), fits + 1), too_many - 1)
        fits, too_many = (guess, too_many) if total(guess) <= memory else (fits, guess)
    return fits


def _step(model: NerfDiff, batch_size: int, target_views: int, height: int, width: int) -> None:
    source = torch.empty(batch_size, 3, height, width)
    targets = torch.empty(batch_size * target_views, 3, height, width)
    bounds = torch.empty(batch_size)
    cameras = Cameras(torch.empty(batch_size, 4, 4), torch.empty(batch_size, 3, 3), height, width)
    c2w, K = (m[:, None].repeat(1, target_views, 1, 1) for m in (cameras.c2w, cameras.K))
    views = Cameras(c2w, K, height, width)
    jitter = torch.empty(batch_size, target_views * height * width, model.renderer.samples_per_ray)

    encoding = model.encode_images(source, cameras, bounds, bounds)
    rendering = model.render(encoding, views, jitter)
    condition = model.condition(encoding, views, rendering.images)
    velocity = model.denoiser.velocity(targets, targets.new_empty(len(targets)), condition)
    (F.mse_loss(condition.rendered, targets) + F.mse_loss(velocity, targets)).backward()


def is_tight(model_config: Mapping, device: torch.device) -> bool:
    """Return true if the state alone takes a quarter of the free memory, so that a step is worth tracing."""
    parameters = sum(p.numel() for p in build_on_meta(model_config).parameters())
    return 4 * WEIGHTS_ADAM_EMA * parameters >= free_memory(device)


def within_memory(
    model_config: Mapping,
    device: torch.device,
    batch_size: int,
    target_views: int,
    height: int,
    width: int,
    precision: str,
) -> dict:
    """Return settings that fit the memory: `unet.checkpointing=auto` becomes as little recomputing as it allows.

    A run that the device cannot hold is refused before it begins.

    Args:
        model_config, batch_size, precision: as for `training_memory`.

    Raises:
        ConfigError: it takes more than is free on `device`; the message says how much, for what, and what takes less.
    """
    free, unet = free_memory(device), model_config["unet"]
    automatic = unet["checkpointing"] == AUTO
    choices = [unet["checkpointing"]]
    if automatic:
        most = [unet.get("patch", 1) * 2**level for level in range(len(unet["channel_mult"]))]
        # the largest images first: they hold the most, and cost no more to compute anew
        choices = [False, *(most[: count + 1] for count in range(len(most) - 1)), True]
    for choice in choices:
        fitting = dict(model_config) | {"unet": dict(unet) | {"checkpointing": choice}}
        needed = training_memory(fitting, batch_size, target_views, height, width, precision)
        if needed.total <= free * (HEADROOM if automatic else 1):
            break
    state, step, available = (amount / 2**30 for amount in (needed.state, needed.step, free))
    message = (
        f"training takes about {state + step:.1f} GiB: {state:.1f} of weights, Adam and EMA, and {step:.1f} "
        f"of gradients and activations for {batch_size} x {height}x{width} at once; {device.type} has "
        f"{available:.1f} GiB free"
    )
    if needed.total > free:
        raise ConfigError(
            f"{message}. Choose a smaller model or more memory; trainer.accumulate_grad_batches=N passes the batch "
            "through in N parts, model.unet.checkpointing=true (or, say, [1,2]: where images are as large as the input "
            "or half) and a smaller model.render.chunk recompute more and keep less"
        )
    log.info("%s", f"{message} (model.unet.checkpointing={choice})" if automatic else message)
    return fitting
