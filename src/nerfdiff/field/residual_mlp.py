"""The deep MLPs of pixel-aligned NeRFs: residual blocks between a point's encoding and its colour and density."""

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from nerfdiff.diffusion.blocks import zero
from nerfdiff.field.decoder import activated
from nerfdiff.utils.errors import ConfigError
from nerfdiff.utils.precision import full_precision


class ResidualBlock(nn.Module):
    """x + fc(relu(fc(relu(x)))), at first the identity."""

    def __init__(self, width: int):
        super().__init__()
        self.first = _he(nn.Linear(width, width))
        self.second = zero(nn.Linear(width, width))

    def forward(self, x: Float[Tensor, "*points width"]) -> Float[Tensor, "*points width"]:
        return x + self.second(F.relu(self.first(F.relu(x))))


class ResidualMLP(nn.Module):
    """Map a point's position and viewing direction to colour and density, given the features of its pixel.

    The features enter through a linear layer of their own before each of the first `injections` blocks. With 3 of 5
    blocks this is pixelNeRF's network; with 1 of 6 it is VisionNeRF's, as a layer over inputs that are put side by side
    is the sum of one over each.

    Args:
        channels: of the features.
        hidden: width of all layers.
        blocks: residual blocks, of two layers each.
        injections: blocks that are given the features.
        frequencies: octaves of the positional encoding.
        first_frequency: the lowest of them, in radians per unit of position.
        density_shift, density_scale: as of the triplane's `Decoder`.

    Raises:
        ConfigError: there are fewer blocks than are to be given the features, or none is.
    """

    def __init__(
        self,
        channels: int,
        hidden: int,
        blocks: int,
        injections: int,
        frequencies: int,
        first_frequency: float,
        density_shift: float,
        density_scale: float,
    ):
        super().__init__()
        if not 1 <= injections <= blocks:
            raise ConfigError(f"model.field.mlp.injections={injections} must be at least 1 and at most blocks={blocks}")
        self.frequencies, self.first_frequency = frequencies, first_frequency
        self.density_shift, self.density_scale = density_shift, density_scale
        self.position = _he(nn.Linear(3 * (1 + 2 * frequencies) + 3, hidden))
        self.features = nn.ModuleList(_he(nn.Linear(channels, hidden)) for _ in range(injections))
        self.blocks = nn.ModuleList(ResidualBlock(hidden) for _ in range(blocks))
        self.output = nn.Linear(hidden, 4)  # not He's weights: density starts as density_shift has it

    def forward(
        self,
        position: Float[Tensor, "*points 3"],
        direction: Float[Tensor, "*points 3"],
        features: Float[Tensor, "*points channels"],
    ) -> tuple[Float[Tensor, "*points 3"], Float[Tensor, "*points"]]:
        """Return colour in [0, 1], and density per unit of the frustum's depth, both fp32."""
        weight, bias = self.injection()
        return self.from_injected(position, direction, F.linear(features, weight, bias))

    def injection(self) -> tuple[Float[Tensor, "injected channels"], Float[Tensor, "injected"]]:
        """Return weight and bias of the layers that take the features, one below the other."""
        weights, biases = ([getattr(layer, name) for layer in self.features] for name in ("weight", "bias"))
        return torch.cat(weights), torch.cat(biases)

    def from_injected(
        self,
        position: Float[Tensor, "*points 3"],
        direction: Float[Tensor, "*points 3"],
        injected: Float[Tensor, "*points injected"],
    ) -> tuple[Float[Tensor, "*points 3"], Float[Tensor, "*points"]]:
        """Return colour and density as `forward` does, given the outputs of the `injection` layers."""
        h = self.position(torch.cat([self.encoded(position), direction], -1))
        shares = injected.chunk(len(self.features), -1)
        for number, block in enumerate(self.blocks):
            if number < len(shares):
                h = h + shares[number]
            h = block(h)
        return activated(self.output(F.relu(h)), self.density_shift, self.density_scale)

    def encoded(self, position: Float[Tensor, "*points 3"]) -> Float[Tensor, "*points encoding"]:
        """Return the position, then sines and cosines of its coordinates at all frequencies, in fp32."""
        octaves = torch.arange(self.frequencies, device=position.device)
        with full_precision(position.device):
            angles = (position[..., None, :] * (self.first_frequency * 2.0**octaves)[:, None]).flatten(-2)
            return torch.cat([position, angles.sin(), angles.cos()], -1)


def _he(layer: nn.Linear) -> nn.Linear:
    """Set pixelNeRF's initial weights."""
    nn.init.kaiming_normal_(layer.weight)
    nn.init.zeros_(layer.bias)
    return layer
