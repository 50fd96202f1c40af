"""Shift-tolerant LPIPS (Ghildyal and Liu, 2022): its networks, and the distance that a field is fitted by.

A field is fitted with AlexNet and scored with VGG16 (`nerfdiff.metrics.perceptual`): with one network for both, the
score would be what is optimised.
"""

from functools import cache
from importlib.resources import as_file, files

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

LEAST = 21
"""Side in pixels of the smallest images that ST-AlexNet takes: below it, a map is smaller than its padding."""


def at_least(images: Float[Tensor, "n 3 h w"], size: int) -> Float[Tensor, "n 3 H W"]:
    """Images whose shorter side is below `size` pixels, enlarged bilinearly until it is; others as they are.

    VGG halves its input four times, and reflects it at the border in the shift-tolerant variant.
    """
    if (shorter := min(images.shape[-2:])) >= size:
        return images
    height, width = (round(side * size / shorter) for side in images.shape[-2:])
    return F.interpolate(images, (height, width), mode="bilinear", align_corners=False)


def shift_tolerant(net: str) -> nn.Module:
    """Load a network, frozen, on the CPU; its weights come with the package.

    Args:
        net: `alex` or `vgg`.
    """
    from stlpips_pytorch import stlpips  # imports IPython, which takes seconds

    # On the meta device no time (or random state) goes into weights that are replaced at once.
    with torch.device("meta"):
        made = stlpips.LPIPS(net=net, variant="shift_tolerant", pretrained=False, verbose=False)
    with as_file(files("stlpips_pytorch") / "weights" / "vST0.0" / f"{net}_shift_tolerant.pth") as path:
        weights = torch.load(path, map_location="cpu", weights_only=True)
    # The file names every linear layer once (lin0); the module also knows it as lins.0, the same object.
    weights |= {f"lins.{i}.model.1.weight": weights[f"lin{i}.model.1.weight"] for i in range(5)}
    made.load_state_dict(weights, assign=True)
    return made.requires_grad_(False).eval()


_loaded = cache(shift_tolerant)


class STAlex:
    """ST-LPIPS on AlexNet as a loss. No `nn.Module`, so that it is no part of what is saved, fitted or averaged.

    Args:
        device: where it computes, in single precision even under autocast.
    """

    def __init__(self, device: torch.device | str = "cpu"):
        self.net = _loaded("alex") if torch.device(device).type == "cpu" else shift_tolerant("alex").to(device)
        self.device = torch.device(device)

    def __call__(self, images: Float[Tensor, "n 3 h w"], truth: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n"]:
        """Return the distance of each pair of images in [0, 1]; gradients go to the first of each pair.

        Images smaller than `LEAST` are enlarged to it.
        """
        with torch.autocast(self.device.type, enabled=False):
            with torch.no_grad():
                expected = self._features(truth)
            found = self._features(images)
            pairs = zip(self.net.lins, found, expected, strict=True)
            return torch.stack([lin((a - b).square()).mean((1, 2, 3)) for lin, a, b in pairs]).sum(0)

    def _features(self, images: Float[Tensor, "n 3 h w"]) -> list[Tensor]:
        """Return the activations of all layers, each of unit length over its channels."""
        scaled = self.net.scaling_layer(2 * at_least(images.float(), LEAST) - 1)
        # an epsilon under the root: a length of zero, as of channels that are all off, has no gradient
        return [map_ * (map_.square().sum(1, keepdim=True) + 1e-10).rsqrt() for map_ in self.net.net(scaled)]
