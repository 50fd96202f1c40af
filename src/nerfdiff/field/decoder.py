"""The NeRF module f_θ: a shallow MLP on triplane features (paper, "Implementation Details")."""

import copy
from collections.abc import Callable

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from nerfdiff.utils.precision import at_least_single


class Decoder(nn.Module):
    """Two linear layers from ξ_W(x) to colour and density. No view direction: colour is a property of the point.

    Args:
        channels: feature channels of the triplane.
        hidden: width of the hidden layer.
        density_shift: added before the softplus; with `density_scale` it sets how opaque space starts out.
        density_scale: density in units of 1 / (t_f − t_n) where the softplus gives 1; making density relative to
            the frustum's depth frees the network from the scene's units.
    """

    def __init__(self, channels: int, hidden: int, density_shift: float, density_scale: float):
        super().__init__()
        self.hidden = nn.Linear(channels, hidden)
        self.output = nn.Linear(hidden, 4)
        self.density_shift = density_shift
        self.density_scale = density_scale

    @property
    def settings(self) -> dict[str, int | float]:
        """Arguments that make another decoder of this shape."""
        return {
            "channels": self.hidden.in_features,
            "hidden": self.hidden.out_features,
            "density_shift": self.density_shift,
            "density_scale": self.density_scale,
        }

    def for_scenes(self, scenes: int) -> "Decoder":
        """Return a copy to fit; for several scenes with parameters of each along a leading axis."""
        return self._changed(lambda value: value.expand(scenes, *value.shape) if scenes > 1 else value)

    def of_scene(self, scene: int) -> "Decoder":
        """Return a copy with one scene's parameters, of a decoder made `for_scenes`."""
        return self._changed(lambda value: value[scene] if self.hidden.weight.ndim == 3 else value)

    def _changed(self, function: Callable[[Tensor], Tensor]) -> "Decoder":
        copied = copy.deepcopy(self)
        for layer in (copied.hidden, copied.output):
            for name, value in list(layer.named_parameters()):
                setattr(layer, name, nn.Parameter(function(value.detach()).clone()))
        return copied

    def forward(
        self, features: Float[Tensor, "*points channels"]
    ) -> tuple[Float[Tensor, "*points 3"], Float[Tensor, "*points"]]:
        """Return colour in [0, 1], and density per unit of the frustum's depth, both fp32."""
        return self.activated(_linear(self.output, F.silu(_linear(self.hidden, features))))

    def activated(self, out: Float[Tensor, "*points 4"]) -> tuple[Float[Tensor, "*points 3"], Float[Tensor, "*points"]]:
        """Return colour and density from the output layer's numbers."""
        return activated(out, self.density_shift, self.density_scale)


def activated(
    out: Float[Tensor, "*points 4"], density_shift: float, density_scale: float
) -> tuple[Float[Tensor, "*points 3"], Float[Tensor, "*points"]]:
    """Return colour in [0, 1] and density, both fp32, from a network's four outputs."""
    out = at_least_single(out)
    # Softplus: exp overflows in half precision, and a ReLU dies on white backgrounds.
    density = density_scale * F.softplus(out[..., 3] + density_shift)
    return out[..., :3].sigmoid(), density


def _linear(layer: nn.Linear, x: Float[Tensor, "*points channels"]) -> Float[Tensor, "*points out"]:
    """Apply a layer, or one for each scene of a batch [scenes, n, channels]."""
    if layer.weight.ndim == 2:
        return layer(x)
    return torch.baddbmm(layer.bias[:, None], x, layer.weight.mT)
