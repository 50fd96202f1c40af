"""Numbers that a run can have, checked in every config before anything runs."""

import math
from collections.abc import Iterator
from fnmatch import fnmatchcase
from typing import Any

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from nerfdiff.utils.errors import ConfigError

AT_LEAST_0, AT_LEAST_1 = (0, math.inf, "at least 0"), (1, math.inf, "at least 1")
ABOVE_0 = (math.nextafter(0, 1), math.inf, "more than 0")
BELOW_1 = (0, math.nextafter(1, 0), "from 0 to less than 1")
SHARE = (0, 1, "from 0 to 1")

LIMITS: dict[str, tuple[float, float, str]] = {
    "trainer.max_steps": AT_LEAST_1,
    "trainer.accumulate_grad_batches": AT_LEAST_1,
    "trainer.log_every_n_steps": AT_LEAST_1,
    "trainer.gradient_clip_val": AT_LEAST_0,
    "trainer.num_sanity_val_steps": (-1, math.inf, "at least -1"),
    "seed": (0, 2**32 - 1, "from 0 to 2^32 - 1"),
    "threads": (1, 2**15, "from 1 to 2^15, or null"),
    "validation_every": AT_LEAST_1,
    "validation_times": SHARE,
    "optimizer.lr": ABOVE_0,
    "optimizer.weight_decay": AT_LEAST_0,
    "optimizer.betas": BELOW_1,
    "optimizer.warmup_steps": AT_LEAST_0,
    "losses.lambda_*": AT_LEAST_0,
    "callbacks.heartbeat.every": ABOVE_0,
    "callbacks.heartbeat.patience": ABOVE_0,
    "callbacks.ema.decay": SHARE,
    "callbacks.ema.warmup": AT_LEAST_0,
    "callbacks.last.every_n_steps": AT_LEAST_1,
    "callbacks.nonfinite.patience": AT_LEAST_1,
    "callbacks.nonfinite.memory": AT_LEAST_1,
    "callbacks.nonfinite.spike": (math.nextafter(1, 2), math.inf, "more than 1"),
    "callbacks.previews.scenes": AT_LEAST_1,
    "callbacks.previews.sampler.steps": AT_LEAST_1,
    "callbacks.progress.every_steps": AT_LEAST_1,
    "callbacks.progress.every_seconds": ABOVE_0,
    "data.num_workers": (0, 1024, "from 0 to 1024"),
    "data.batch_size": AT_LEAST_1,
    "data.image_size": (1, 2**14, "from 1 to 16384 pixels"),
    "data.background": SHARE,
    "model.unet.width": AT_LEAST_1,
    "model.unet.patch": AT_LEAST_1,
    "model.unet.channel_mult": AT_LEAST_1,
    "model.unet.res_blocks": (1, 64, "from 1 to 64"),
    "model.unet.head_channels": AT_LEAST_1,
    "model.unet.dropout": BELOW_1,
    "model.field.channels": AT_LEAST_1,
    "model.field.hidden": AT_LEAST_1,
    "*uniform_samples": AT_LEAST_1,
    "importance_samples": AT_LEAST_1,
    "model.render.importance_samples": AT_LEAST_0,
    "*chunk": (1024, math.inf, "at least 1024 points"),
    "*views_at_once": AT_LEAST_1,
    "budget.inner_steps": AT_LEAST_0,
    "strategy.inner_steps": AT_LEAST_0,
    **{f"budget.{key}": AT_LEAST_1 for key in ("steps", "sampler_steps", "rays", "views", "deep_every")},
    "budget.guidance_samples": AT_LEAST_1,
    "strategy.guidance_importance_samples": AT_LEAST_0,
    "strategy.rays": AT_LEAST_1,
    "strategy.steps": AT_LEAST_1,
    "strategy.teacher.steps": AT_LEAST_1,
    "strategy.lr_planes": AT_LEAST_0,
    "strategy.lr_decoder": AT_LEAST_0,
    "strategy.*tolerance": AT_LEAST_0,
    "strategy.*deep.every": AT_LEAST_1,
    "prior.views": AT_LEAST_1,
    "picture_views.views": AT_LEAST_1,
    "picture_size": (1, 2**14, "from 1 to 16384 pixels"),
    "scenes_at_once": AT_LEAST_1,
    "mean_image_scenes": AT_LEAST_1,
    "seconds_per_scene": (math.nextafter(0, 1), math.inf, "more than 0, or null"),
    "minutes": (math.nextafter(0, 1), math.inf, "more than 0, or null"),
    "progress_every": ABOVE_0,
    "keep_steps": AT_LEAST_0,
    "port": (0, 65535, "from 0 to 65535"),
    "frame_seconds": ABOVE_0,
    "most_pixels": (2**10, math.inf, "at least 1024"),
    "background": SHARE,
    "processes": AT_LEAST_1,
    "metrics.psnr_floor": ABOVE_0,
    "metrics.opacity_threshold": SHARE,
    "metrics.min_size": AT_LEAST_1,
    "metrics.batch": AT_LEAST_1,
    "metrics.geometry.floater_*": AT_LEAST_1,
    "metrics.geometry.hull_margin": AT_LEAST_0,
    "metrics.geometry.invisible": SHARE,
    "metrics.geometry.depth_tails": (0, math.nextafter(0.5, 0), "from 0 to less than 0.5"),
    "metrics.*.seed": (0, 2**32 - 1, "from 0 to 2^32 - 1"),
    "metrics.consistency.scenes": AT_LEAST_0,
    "metrics.consistency.lr": ABOVE_0,
    "metrics.consistency.initial_std": AT_LEAST_0,
    **{f"metrics.consistency.{key}": AT_LEAST_1 for key in ("views", "steps", "rays", "channels", "hidden")},
    "metrics.consistency.plane_size": (2, 2**12, "from 2 to 4096"),
    "metrics.consistency.importance_samples": AT_LEAST_0,
    "sample.*": AT_LEAST_1,
    "listed": AT_LEAST_0,
    "sheet.scenes": AT_LEAST_0,
    "sheet.views": AT_LEAST_1,
    "elevation": (-89, 89, "from -89 to 89 degrees"),
    "points": AT_LEAST_1,
    "height": (1, 2**14, "from 1 to 16384 pixels"),
    "fps": AT_LEAST_1,
    "views": AT_LEAST_1,
    "path.frames": AT_LEAST_1,
    "orbit.frames": AT_LEAST_0,
    "orbit.scenes": AT_LEAST_0,
    "orbit.fps": AT_LEAST_1,
}
"""By keys, in which * stands for any part: the least and largest number and these in words. The first that fits counts;
of a list, each number is meant."""

SWITCHED_OFF = {"orbit": "orbit.frames=0", "sheet": "sheet.scenes=0"}
"""Groups of settings that are needed, and what switches off what they are about."""


def check_limits(config: DictConfig) -> None:
    """Refuse a composed config with a number that no run can have, or without settings that are needed.

    Raises:
        ConfigError: naming the key, its value and what it can be.
    """
    # what was set before what follows from it: the message is to name the key that a person set
    for key, value, _ in sorted(_values(config), key=lambda found: found[2]):
        if value is None and key in SWITCHED_OFF:
            raise ConfigError(f"{key}=null: for none, set {SWITCHED_OFF[key]}")
        check_limit(key, value)


def check_limit(key: str, value: Any) -> None:
    """Refuse a value, of a list each of its numbers, that a key cannot have.

    Raises:
        ConfigError: see `check_limits`.
    """
    low, high, words = next((LIMITS[like] for like in LIMITS if fnmatchcase(key, like)), (-math.inf, math.inf, ""))
    for number in value if isinstance(value, list) else [value]:
        if isinstance(number, int | float) and not isinstance(number, bool):
            if not math.isfinite(number):
                raise ConfigError(f"{key}={value} must be a finite number")
            if not low <= number <= high:
                raise ConfigError(f"{key}={value} must be {words}")
        elif words and number is not None and number != "auto":
            raise ConfigError(f"{key}={value} must be a number, {words}")


def _values(config: DictConfig, prefix: str = "") -> Iterator[tuple[str, Any, bool]]:
    """All keys but Hydra's own, their values, and whether these are another key's; not what is known only later."""
    for key in config:
        if f"{prefix}{key}" == "hydra":
            continue
        try:
            value = config[key]
        except (OmegaConfBaseException, ValueError):  # a ValueError: Hydra has not begun
            continue
        if isinstance(value, DictConfig):
            yield from _values(value, f"{prefix}{key}.")
        else:
            value = OmegaConf.to_container(value) if OmegaConf.is_list(value) else value
            yield f"{prefix}{key}", value, OmegaConf.is_interpolation(config, key)
