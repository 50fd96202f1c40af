"""Weight files of the real networks' shapes with arbitrary values, and a few kilobytes on disk."""

from pathlib import Path

import torch
from torch import Tensor


def small_on_disk(shape: tuple[int, ...], seed: int, scale: float) -> Tensor:
    """A tensor of this shape whose values repeat: all axes step by one through a short storage."""
    storage = torch.randn(sum(shape) + 1, generator=torch.Generator().manual_seed(seed)) * scale
    return storage.as_strided(shape, (1,) * len(shape))


def write_vgg16(path: Path) -> dict[str, Tensor]:
    """torchvision's VGG16, convolutions only."""
    from torchvision.models import vgg16

    with torch.device("meta"):
        shapes = {k: tuple(v.shape) for k, v in vgg16().state_dict().items() if k.startswith("features")}
    weights = {k: small_on_disk(shape, i, 0.02) for i, (k, shape) in enumerate(shapes.items())}
    torch.save(weights, path)
    return weights


def write_inception(path: Path) -> None:
    """torch-fidelity's Inception v3."""
    from torch_fidelity.feature_extractor_inceptionv3 import FeatureExtractorInceptionV3 as Inception

    class Untrained(Inception):
        def load_state_dict(self, *args, **kwargs):
            """Keep what construction gave."""

    torch.save({}, path)
    with torch.device("meta"):
        shapes = Untrained("inception-v3-compat", ["2048"], str(path)).state_dict()
    weights = {}
    for i, (key, value) in enumerate(shapes.items()):
        if key.endswith("running_var"):
            weights[key] = torch.ones(1).expand(value.shape)
        elif key.endswith("num_batches_tracked"):
            weights[key] = torch.zeros((), dtype=torch.long)
        elif key.endswith("bn.weight"):
            weights[key] = torch.full((1,), 1.5).expand(value.shape)
        else:
            weights[key] = small_on_disk(tuple(value.shape), i, 0.05)
    torch.save(weights, path)
