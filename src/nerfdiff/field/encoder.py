"""The image encoder e_ψ: from one image to a field's features, and features for the CDM to attend to."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor, nn

from nerfdiff.cameras import Cameras
from nerfdiff.diffusion.unet import Context, UNet
from nerfdiff.field.pixel_features import PixelFeatures
from nerfdiff.field.resnet import ResNetPyramid
from nerfdiff.field.triplane import Triplane
from nerfdiff.field.vision_features import VisionFeatures
from nerfdiff.utils.errors import ConfigError
from nerfdiff.utils.images import to_signed


@runtime_checkable
class Features(Protocol):
    """W, of whatever kind: what a field is made of, and the bounds of each scene."""

    near: Float[Tensor, "batch"]
    far: Float[Tensor, "batch"]


@dataclass(frozen=True)
class Encoding:
    """Features of a scene, computed once per input image.

    Args:
        source: the input images in [0, 1].
        features: W = e_ψ(I^s).
        context: attended to by the CDM: the encoder's features after each attention block, or their keys and values.
    """

    source: Float[Tensor, "batch 3 height width"]
    features: Features
    context: Context

    @property
    def triplane(self) -> Triplane:
        """The triplane W, the features of a field that can be fitted.

        Raises:
            ConfigError: W is no triplane.
        """
        if isinstance(self.features, Triplane):
            return self.features
        raise ConfigError(
            "this checkpoint's field is a pixel-aligned NeRF, which has no triplane to fit to a scene: it renders with "
            "strategy=none and conditions strategy=cdm; the others take a checkpoint trained with field=triplane"
        )


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
        out, features = self.unet(to_signed(source))
        planes = out.float().unflatten(1, (3, self.channels))
        return Encoding(source, Triplane(planes, cameras, near, far), features)


class PixelEncoder(nn.Module):
    """The image encoders of pixel-aligned NeRFs; the CDM has nothing of theirs to attend to.

    Args:
        backbone: from images to feature maps.
        with_image: give points the colour of their pixel beside its features, as VisionNeRF does.
    """

    def __init__(self, backbone: ResNetPyramid | VisionFeatures, with_image: bool):
        super().__init__()
        self.backbone = backbone
        self.with_image = with_image
        self.channels = backbone.out_channels + 3 * with_image

    def forward(
        self,
        source: Float[Tensor, "batch 3 height width"],
        cameras: Cameras,
        near: Float[Tensor, "batch"],
        far: Float[Tensor, "batch"],
    ) -> Encoding:
        """Encode input images in [0, 1] seen by `cameras` [batch]."""
        image = to_signed(source)
        maps = (self.backbone(image).float(), *([image] if self.with_image else []))
        return Encoding(source, PixelFeatures(maps, cameras, near, far), [])
