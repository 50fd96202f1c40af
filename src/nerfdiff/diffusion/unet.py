"""The ADM U-Net, for the image encoder (no time) and for the CDM (time, and attention to the encoder)."""

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from nerfdiff.diffusion.blocks import Attention, Downsample, ResBlock, Upsample, norm, time_embedding, zero


class Stage(nn.Module):
    """A residual block, then at some resolutions self-attention, then where conditioned cross-attention."""

    def __init__(self, res: ResBlock, attention: Attention | None, cross: Attention | None):
        super().__init__()
        self.res = res
        self.attention = attention
        self.cross = cross

    def forward(self, x: Tensor, embedding: Tensor | None, context: Tensor | None) -> Tensor:
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
        checkpointing: recompute every stage in the backward pass instead of keeping its activations.
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
        checkpointing: bool,
    ):
        super().__init__()
        self.width = width
        self.checkpointing = checkpointing
        embedding = 4 * width if with_time else None
        self.embed = None
        if with_time:
            self.embed = nn.Sequential(nn.Linear(width, embedding), nn.SiLU(), nn.Linear(embedding, embedding))

        def stage(channels: int, out: int, attends: bool) -> Stage:
            return Stage(
                ResBlock(channels, out, embedding, dropout),
                Attention(out, head_channels, cross=False) if attends else None,
                Attention(out, head_channels, cross=True) if attends and cross_attention else None,
            )

        channels = width
        self.conv_in = nn.Conv2d(in_channels, width, 3, padding=1)
        skips = [width]
        self.down = nn.ModuleList()
        for level, mult in enumerate(channel_mult):
            if level > 0:
                self.down.append(Downsample(channels))
                skips.append(channels)
            for _ in range(res_blocks):
                self.down.append(stage(channels, mult * width, 2**level in attention_downsampling))
                channels = mult * width
                skips.append(channels)
        self.middle = nn.ModuleList([stage(channels, channels, True), stage(channels, channels, False)])
        self.up = nn.ModuleList()
        for level, mult in reversed(list(enumerate(channel_mult))):
            if level < len(channel_mult) - 1:
                self.up.append(Upsample(channels))
            for _ in range(res_blocks + 1):
                attends = 2**level in attention_downsampling
                self.up.append(stage(channels + skips.pop(), mult * width, attends))
                channels = mult * width
        self.norm_out = norm(channels)
        conv_out = nn.Conv2d(channels, out_channels, 3, padding=1)
        self.conv_out = zero(conv_out) if zero_output else conv_out

    def forward(
        self,
        x: Float[Tensor, "batch in_channels height width"],
        t: Float[Tensor, "batch"] | None = None,
        context: Sequence[Tensor] = (),
    ) -> tuple[Float[Tensor, "batch out_channels height width"], list[Tensor]]:
        """Output image, and the features after every attention block in order: the context of another U-Net.

        Args:
            t: times in [0, 1], if built `with_time`.
            context: another U-Net's features, if built with `cross_attention`.
        """
        embedding = None
        if self.embed is not None:
            embedding = self.embed(time_embedding(t, self.width).to(x.dtype))
        context = iter(context)
        features: list[Tensor] = []

        def run(stage: Stage, h: Tensor) -> Tensor:
            attended = next(context) if stage.cross is not None else None
            if self.checkpointing and torch.is_grad_enabled():
                h = checkpoint(stage, h, embedding, attended, use_reentrant=False)
            else:
                h = stage(h, embedding, attended)
            if stage.attention is not None:
                features.append(h)
            return h

        h = self.conv_in(x)
        skips = [h]
        for module in self.down:
            h = run(module, h) if isinstance(module, Stage) else module(h)
            skips.append(h)
        for module in self.middle:
            h = run(module, h)
        for module in self.up:
            if isinstance(module, Upsample):
                h = module(h, skips[-1].shape[-2:])
            else:
                h = run(module, torch.cat([h, skips.pop()], 1))
        return self.conv_out(F.silu(self.norm_out(h))), features
