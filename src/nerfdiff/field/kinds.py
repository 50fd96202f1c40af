"""The single-image NeRFs there are, by name: the paper's triplanes, and the pixel-aligned ones beside them."""

from collections.abc import Mapping

from nerfdiff.field.decoder import Decoder
from nerfdiff.field.encoder import Encoder, PixelEncoder
from nerfdiff.field.residual_mlp import ResidualMLP
from nerfdiff.field.resnet import ResNetPyramid
from nerfdiff.field.vision_features import VisionFeatures
from nerfdiff.utils.errors import ConfigError

TRIPLANE, PIXELNERF, VISIONNERF = FIELDS = ("triplane", "pixelnerf", "visionnerf")


def encoder_and_decoder(
    name: str, settings: Mapping, unet: Mapping
) -> tuple[Encoder | PixelEncoder, Decoder | ResidualMLP]:
    """Build the encoder e_ψ and the decoder f_θ.

    Args:
        name: `triplane`: a U-Net's planes and a shallow decoder; `pixelnerf`: a ResNet's features and a deep MLP;
            `visionnerf`: a vision transformer's, and a deeper one.
        settings: of a triplane `channels`, and the arguments of `Decoder`; of the others `encoder` and `mlp`, and
            `density_shift` and `density_scale`.
        unet: sizes of the U-Net.

    Raises:
        ConfigError: another name, or sizes that do not fit together.
    """
    if name == TRIPLANE:
        return Encoder(settings["channels"], unet), Decoder(**settings)
    if name not in FIELDS:
        raise ConfigError(f"model.field.name={name!r}: choose {', '.join(FIELDS)}")
    settings = dict(settings)
    backbone, mlp = settings.pop("encoder"), settings.pop("mlp")
    if name == PIXELNERF:
        encoder = PixelEncoder(ResNetPyramid(**backbone), with_image=False)
    else:
        encoder = PixelEncoder(VisionFeatures(**backbone), with_image=True)
    return encoder, ResidualMLP(encoder.channels, **mlp, **settings)
