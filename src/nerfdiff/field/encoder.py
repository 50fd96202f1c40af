"""The image encoder e_ψ: one image to a camera-aligned triplane, and features for the CDM to attend to."""

from collections.abc import Mapping
from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor, nn

from nerfdiff.cameras import Cameras
from nerfdiff.diffusion.unet import Context, UNet
from nerfdiff.field.triplane import Triplane


@dataclass(frozen=True)
class Encoding:
    """What is known of a scene after one look: computed once per input image, whatever follows.

    Args:
        source: the input images in [0, 1].
        triplane: W = e_ψ(I^s).
        context: what the CDM attends to: the encoder's features after each attention block, or `NerfDiff.settled`.
    """

    source: Float[Tensor, "batch 3 height width"]
    triplane: Triplane
    context: Context


class Encoder(nn.Module):
    """An ADM U-Net without time whose output is cut into three planes of the image's resolution."""

    def __init__(self, channels: int, unet: Mapping):
        super().__init__()
        self.channels = channels
        self.unet = UNet(3, 3 * channels, **unet, with_time=False, cross_attention=False, zero_output=False)

    def forward(
        self,
        source: Float[Tensor, "batch 3 height width"],
        cameras: Cameras,
        near: Float[Tensor, "batch"],
        far: Float[Tensor, "batch"],
    ) -> Encoding:
        """Encode input images in [0, 1] seen by `cameras` [batch]."""
        out, features = self.unet(2 * source - 1)
        planes = out.float().unflatten(1, (3, self.channels))
        return Encoding(source, Triplane(planes, cameras, near, far), features)
