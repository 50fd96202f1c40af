"""The ADM U-Net, for the image encoder (no time) and for the CDM (time, and attention to the encoder)."""

from collections.abc import Callable, Sequence

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from nerfdiff.diffusion.blocks import (
    Attention,
    Downsample,
    KeyValue,
    ResBlock,
    Upsample,
    norm,
    time_embedding,
    zero,
)
from nerfdiff.diffusion.deep_features import DeepFeatures
from nerfdiff.diffusion.norm_silu import norm_silu
from nerfdiff.utils.errors import ConfigError

Context = Sequence[Tensor | KeyValue]
"""Features that a U-Net attends to, one entry per attention block: another U-Net's, or `UNet.keys_values` of them."""

AUTO = "auto"
"""Value of `checkpointing` that training replaces by what fits the memory."""


class Stage(nn.Module):
    """A residual block, then at some resolutions self-attention, then where conditioned cross-attention.

    Args:
        recompute: in the backward pass, instead of keeping activations (up to whoever calls it).
    """

    def __init__(self, res: ResBlock, attention: Attention | None, cross: Attention | None, recompute: bool):
        super().__init__()
        self.res = res
        self.attention = attention
        self.cross = cross
        self.recompute = recompute

    def forward(
        self, x: Tensor, skip: Tensor | None, embedding: Tensor | None, context: Tensor | KeyValue | None
    ) -> Tensor:
        if skip is not None:
            x = torch.cat([x, skip], 1)
        x = self.res(x, embedding)
        if self.attention is not None:
            x = self.attention(x)
        if self.cross is not None:
            x = self.cross(x, context)
        return x


class UNet(nn.Module):
    """ADM's U-Net without residual up- and downsampling (paper: "All other hyperparameters follow ADM").

    Args:
        in_channels, out_channels: of the images in and out.
        width: model dimension d.
        channel_mult: width of each resolution, in units of d; each entry but the last halves the resolution.
        res_blocks: residual blocks per resolution.
        attention_downsampling: attention acts where the image is this many times smaller than the input.
        head_channels: channels per attention head.
        dropout: in residual blocks.
        with_time: condition on t.
        cross_attention: attend to the `features` of a U-Net of the same shape after every attention block.
        zero_output: start with zero output (right for a residual target, wrong for features).
        patch: side of the squares of pixels that become one pixel of more channels before the first convolution, and
            are taken apart after the last (Hoogeboom et al. 2023, arXiv 2301.11093, section 2.4). 1 is ADM's U-Net;
            2 lets images of 64 pixels cost about what images of 32 cost with 1. The first resolution is then already
            `patch` times smaller than the input.
        checkpointing: where the image is this many times smaller than the input, or everywhere (true), every stage is
            recomputed in the backward pass instead of keeping its activations. `auto`, which training
            replaces by what fits the memory, is otherwise everywhere.

    Raises:
        ConfigError: `checkpointing` names a resolution that the U-Net does not have, or `patch` is below 1.
    """

    def __init__(
        self,
        in_channels: int,
        out_channels: int,
        width: int,
        channel_mult: Sequence[int],
        res_blocks: int,
        attention_downsampling: Sequence[int],
        head_channels: int,
        dropout: float,
        with_time: bool,
        cross_attention: bool,
        zero_output: bool,
        checkpointing: bool | str | Sequence[int],
        patch: int = 1,
    ):
        super().__init__()
        if patch < 1:
            raise ConfigError(f"model.unet.patch={patch}: the side of a patch is at least 1 pixel")
        self.patch = patch
        self.width = width
        self.res_blocks = res_blocks
        self.levels = len(channel_mult)
        recomputed = levels_to_recompute(checkpointing, self.levels, patch)
        embedding = 4 * width if with_time else None
        self.embed = None
        if with_time:
            self.embed = nn.Sequential(nn.Linear(width, embedding), nn.SiLU(), nn.Linear(embedding, embedding))

        def stage(channels: int, out: int, level: int, attends: bool) -> Stage:
            return Stage(
                ResBlock(channels, out, embedding, dropout),
                Attention(out, head_channels, cross=False) if attends else None,
                Attention(out, head_channels, cross=True) if attends and cross_attention else None,
                level in recomputed,
            )

        channels = width
        self.conv_in = nn.Conv2d(in_channels * patch**2, width, 3, padding=1)
        skips = [width]
        self.down = nn.ModuleList()
        for level, mult in enumerate(channel_mult):
            if level > 0:
                self.down.append(Downsample(channels))
                skips.append(channels)
            for _ in range(res_blocks):
                self.down.append(stage(channels, mult * width, level, patch * 2**level in attention_downsampling))
                channels = mult * width
                skips.append(channels)
        self.middle = nn.ModuleList(stage(channels, channels, self.levels - 1, attends) for attends in (True, False))
        self.up = nn.ModuleList()
        for level, mult in reversed(list(enumerate(channel_mult))):
            if level < self.levels - 1:
                self.up.append(Upsample(channels))
            for _ in range(res_blocks + 1):
                self.up.append(
                    stage(channels + skips.pop(), mult * width, level, patch * 2**level in attention_downsampling)
                )
                channels = mult * width
        self.norm_out = norm(channels)
        conv_out = nn.Conv2d(channels, out_channels * patch**2, 3, padding=1)
        self.conv_out = zero(conv_out) if zero_output else conv_out

    def forward(
        self,
        x: Float[Tensor, "batch in_channels height width"],
        t: Float[Tensor, "batch"] | None = None,
        context: Context = (),
        deep: DeepFeatures | None = None,
    ) -> tuple[Float[Tensor, "batch out_channels height width"], list[Tensor]]:
        """Return the output image, and the features after every attention block: the context of another U-Net.

        Args:
            t: times in [0, 1], if built `with_time`.
            context: another U-Net's features, if built with `cross_attention`, or `keys_values` of them. They may be
                of fewer scenes: x is then scenes · views images, scene by scene.
            deep: outputs of the deep levels at an earlier call, to reuse; features are then those that were computed.

        Raises:
            ConfigError: `deep` is to begin below the last resolution, or the image is not made of whole patches.
        """
        if any(side % self.patch for side in x.shape[-2:]):
            size = "x".join(map(str, x.shape[-2:]))
            raise ConfigError(f"model.unet.patch={self.patch}: images of {size} pixels are not made of whole patches")
        if deep is not None and deep.reuse.below >= self.levels:
            raise ConfigError(f"deep.below={deep.reuse.below}: of {self.levels} resolutions none is left to reuse")
        embedding = None
        if self.embed is not None:
            embedding = self.embed(time_embedding(t, self.width).to(x.dtype))
        attended = dict(zip(self._attending(), context, strict=True))
        features: list[Tensor] = []

        def run(stage: Stage, h: Tensor, skip: Tensor | None = None) -> Tensor:
            inputs = h, skip, embedding, attended.get(stage)
            recompute = stage.recompute and torch.is_grad_enabled()
            h = checkpoint(stage, *inputs, use_reentrant=False) if recompute else stage(*inputs)
            if stage.attention is not None:
                features.append(h)
            return h

        h = self._level(0, self.conv_in(F.pixel_unshuffle(x, self.patch)), run, deep)
        return F.pixel_shuffle(self.conv_out(norm_silu(self.norm_out, h)), self.patch), features

    def keys_values(self, context: Sequence[Tensor]) -> list[KeyValue]:
        """Return the keys and values of another U-Net's features: a context that is computed once for many calls."""
        return [stage.cross.keys_values(features) for stage, features in zip(self._attending(), context, strict=True)]

    # Methods, not functions that call each other: such a cycle would keep features, and the autograd nodes that made
    # them, until Python happens to look for cycles.
    def _level(self, depth: int, h: Tensor, run: Callable[..., Tensor], deep: DeepFeatures | None) -> Tensor:
        """Run the U-Net at one resolution and all below it."""
        skips = [h]
        for stage in self._down(depth):
            h = run(stage, h)
            skips.append(h)
        if depth == self.levels - 1:
            for stage in self.middle:
                h = run(stage, h)
        elif deep is not None and deep.reuse.below == depth + 1:
            if deep.due:
                deep.last = self._below(depth, h, run, deep)
            h = deep.last
        else:
            h = self._below(depth, h, run, deep)
        for stage in self._up(depth):
            h = run(stage, h, skips.pop())
        return h

    def _below(self, depth: int, h: Tensor, run: Callable[..., Tensor], deep: DeepFeatures | None) -> Tensor:
        down, up = self._between(depth)
        return up(self._level(depth + 1, down(h), run, deep), h.shape[-2:])

    def _attending(self) -> list[Stage]:
        """Return the stages with cross-attention, in the order in which they run."""
        stages = (module for part in (self.down, self.middle, self.up) for module in part)
        return [stage for stage in stages if isinstance(stage, Stage) and stage.cross is not None]

    def _down(self, level: int) -> list[Stage]:
        start = level * (self.res_blocks + 1)
        return list(self.down)[start : start + self.res_blocks]

    def _up(self, level: int) -> list[Stage]:
        start = (self.levels - 1 - level) * (self.res_blocks + 2)
        return list(self.up)[start : start + self.res_blocks + 1]

    def _between(self, level: int) -> tuple[Downsample, Upsample]:
        """Return the layers from a level to the next lower one, and back."""
        down = self.down[level * (self.res_blocks + 1) + self.res_blocks]
        return down, self.up[(self.levels - 1 - level) * (self.res_blocks + 2) - 1]


def levels_to_recompute(checkpointing: bool | str | Sequence[int], levels: int, patch: int = 1) -> frozenset[int]:
    """Return the numbers of the U-Net's resolutions, from 0 for the input's, whose activations are not kept.

    Args:
        checkpointing: of all (true, auto), none (false), or those where the image is this many times smaller.
        patch: how many times smaller than the input the first resolution is.

    Raises:
        ConfigError: there is no such resolution.
    """
    if isinstance(checkpointing, bool) or checkpointing == AUTO:
        return frozenset(range(levels)) if checkpointing else frozenset()
    known = {patch * 2**level: level for level in range(levels)}
    if isinstance(checkpointing, str) or not set(checkpointing) <= known.keys():
        raise ConfigError(
            f"model.unet.checkpointing={checkpointing} must be auto, true, false, or some of {list(known)}: how many "
            "times smaller than the input the images are whose activations are recomputed"
        )
    return frozenset(known[downsampling] for downsampling in checkpointing)
