"""Learned perceptual distances: LPIPS with VGG16, and its shift-tolerant sibling, which needs no download.

Neither class is an `nn.Module`: a metric held by a LightningModule stays out of its checkpoints and its EMA.
"""

from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torchvision.models import VGG16_Weights

from nerfdiff.fit.perceptual import at_least, shift_tolerant
from nerfdiff.metrics.weights import WeightsFile

LPIPS_NET = "vgg16"
LPIPS_VGG = WeightsFile(
    url=VGG16_Weights.IMAGENET1K_V1.url, sha256="397923af", column="lpips", key="metrics.lpips_weights"
)


class LPIPS:
    """LPIPS v0.1 on VGG16 (Zhang et al., 2018) as torchmetrics computes it.

    Args:
        weights: torchvision's VGG16 weights on ImageNet, from `LPIPS_VGG.find`. The linear layers come with
            torchmetrics.
        min_size: see `at_least`, in pixels.
    """

    def __init__(self, weights: Path, device: torch.device | str = "cpu", min_size: int = 32):
        # torchmetrics' public class loads its backbone by URL only; this is the network inside it.
        from torchmetrics.functional.image.lpips import _NoTrainLpips

        with torch.random.fork_rng(devices=[]):
            net = _NoTrainLpips(net="vgg", pnet_rand=True)
        published = torch.load(weights, map_location="cpu", weights_only=True)
        backbone = {}
        for key in net.net.state_dict():
            _, layer = key.split(".", 1)
            backbone[key] = published[f"features.{layer}"]
        net.net.load_state_dict(backbone)
        self.net = net.to(device)
        self.device, self.min_size = torch.device(device), min_size

    @torch.no_grad()
    def __call__(self, predictions: Float[Tensor, "n 3 h w"], truth: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n"]:
        """Distance of each pair of images in [0, 1] (the network sees [−1, 1]), on the CPU."""
        pair = (at_least(x.float().to(self.device), self.min_size) for x in (predictions, truth))
        return self.net(*pair, normalize=True).flatten().cpu()


class STLPIPS:
    """Shift-tolerant LPIPS on VGG16 (Ghildyal and Liu, 2022); its weights come with the package.

    Args:
        min_size: see `at_least`, in pixels; the network takes 20 and more.
    """

    def __init__(self, device: torch.device | str = "cpu", min_size: int = 32):
        self.net = shift_tolerant("vgg").to(device)
        self.device, self.min_size = torch.device(device), min_size
        self._features: list[Tensor] = []
        self.net.net.slice4.register_forward_hook(self._keep)

    def _keep(self, module: nn.Module, inputs: tuple[Tensor], output: Tensor) -> None:
        self._features.append(output.mean(dim=(2, 3)))

    @torch.no_grad()
    def __call__(
        self, predictions: Float[Tensor, "n 3 h w"], truth: Float[Tensor, "n 3 h w"]
    ) -> tuple[Float[Tensor, "n"], Float[Tensor, "n 512"], Float[Tensor, "n 512"]]:
        """Compare images in [0, 1] (the network sees [−1, 1]).

        Returns:
            the distance of each pair, and the features of predictions and of truth for a Fréchet distance:
            the activations relu4_3 (512 channels, an eighth of the image's resolution, not normalised), averaged
            over the image. All on the CPU. The next and last layer's activations are 25 times larger and tell a
            slightly blurred set from a sharp one less well.
        """
        pair = (at_least(x.float().to(self.device), self.min_size) for x in (predictions, truth))
        self._features.clear()
        distance = self.net(*pair, normalize=True).flatten().cpu()
        first, second = (features.cpu() for features in self._features)
        self._features.clear()
        return distance, first, second
