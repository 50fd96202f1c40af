"""The 3D-aware conditional diffusion model (paper, "3D-aware Conditional Diffusion Models")."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int64
from torch import Tensor, nn

from nerfdiff.cameras import Cameras
from nerfdiff.diffusion.blocks import Upsample
from nerfdiff.diffusion.deep_features import DeepFeatures
from nerfdiff.diffusion.schedule import alpha_sigma, expand, x0_from_v
from nerfdiff.diffusion.unet import Context, UNet
from nerfdiff.utils.errors import ConfigError
from nerfdiff.utils.images import to_signed

IMAGES = ("rendered", "source", "none")


def cast_products(denoiser: "Denoiser", dtype: torch.dtype) -> None:
    """Keep the weights of a frozen denoiser's products in the type that autocast gives them at every call.

    In place: for a copy in memory that is only evaluated. Under autocast all results are the same, bit for bit: norms
    stay as they are, and so do weights that a CPU adds up before they are cast (`doubling_kernel`).
    """
    added_up = {layer.conv for layer in denoiser.modules() if isinstance(layer, Upsample)}
    for layer in denoiser.modules():
        if isinstance(layer, nn.Conv2d | nn.Linear) and not (layer.weight.device.type == "cpu" and layer in added_up):
            layer.to(dtype)


def gaussian_velocity(
    z: Float[Tensor, "*shape"],
    mean: Float[Tensor, "*shape"],
    std: float,
    alpha: Float[Tensor, "*#shape"],
    sigma: Float[Tensor, "*#shape"],
) -> tuple[Float[Tensor, "*shape"], Float[Tensor, "*#shape"]]:
    """Return mean and standard deviation of v given Z_t, for x0 ~ N(mean, std²).

    With D = Z − α·mean, E[x0 | Z] = mean + std²α D / (std²α² + σ²), and v = (αZ − x0) / σ becomes
    ασ(1 − std²) D / (std²α² + σ²) − σ·mean, with no division by σ alone. What remains to be learnt is of unit
    scale at every t once divided by the standard deviation, as in EDM (arXiv 2206.00364, eq. 7), whose data
    have mean zero.
    """
    variance = std**2 * alpha**2 + sigma**2
    deviation = z - alpha * mean
    return alpha * sigma * (1 - std**2) / variance * deviation - sigma * mean, std / torch.sqrt(variance)


@dataclass(frozen=True)
class Condition:
    """Inputs that condition the CDM. All but the context share the batch axis, one entry per view to denoise.

    Args:
        rendered: the single-image NeRF's image of the view, in [0, 1].
        source: the input image, in [0, 1].
        cameras: cameras of the views, in the input camera's space.
        near: t_n per view, to which camera positions are relative.
        context: attended to by cross-attention, one entry per scene where the batch is scenes · views, scene by scene.
    """

    rendered: Float[Tensor, "batch 3 height width"]
    source: Float[Tensor, "batch 3 height width"]
    cameras: Cameras
    near: Float[Tensor, "batch"]
    context: Context

    def __getitem__(self, views: slice | Int64[Tensor, "some"]) -> "Condition":
        """Take some of one scene's views."""
        own = {name: getattr(self, name)[views] for name in ("rendered", "source", "cameras", "near")}
        return replace(self, **own)


class Denoiser(nn.Module):
    """ADM U-Net over [Z_t, condition], v-prediction inside, x0 outside. Images live in [-1, 1] here.

    Args:
        image: which image is concatenated with Z_t: `rendered` (the paper's), `source` or `none`.
        ray_maps: concatenate the origin and direction of every pixel's ray in the input camera's space. Without
            a rendered image nothing else tells the CDM which view is wanted.
        cross_attention: attend to the encoder's features after every attention block.
        residual_std: None for the paper's plain v-prediction; a number lets the U-Net predict what is beyond
            x0 ~ N(rendering, residual_std²), in units of [-1, 1] (see `gaussian_velocity`).
        unet: the U-Net's sizes.
    """

    def __init__(self, image: str, ray_maps: bool, cross_attention: bool, residual_std: float | None, unet: Mapping):
        super().__init__()
        if image not in IMAGES:
            raise ConfigError(f"conditioning.image must be one of {', '.join(IMAGES)}, got {image!r}")
        if image != "rendered" and not ray_maps:
            raise ConfigError(
                f"conditioning.image={image} does not show the CDM which view is wanted: set conditioning.ray_maps=true"
            )
        if residual_std is not None and (image != "rendered" or not 0 < residual_std <= 1):
            raise ConfigError(
                f"conditioning.residual_std={residual_std} needs conditioning.image=rendered and a number above 0, at "
                "most 1; null is the paper's prediction of v"
            )
        self.image = image
        self.ray_maps = ray_maps
        self.residual_std = residual_std
        channels = 3 + 3 * (image != "none") + 6 * ray_maps
        self.unet = UNet(channels, 3, **unet, with_time=True, cross_attention=cross_attention, zero_output=True)
        self.cross_attention = cross_attention

    def velocity(
        self,
        z: Float[Tensor, "batch 3 height width"],
        t: Float[Tensor, "batch"],
        condition: Condition,
        deep: DeepFeatures | None = None,
    ) -> Float[Tensor, "batch 3 height width"]:
        """Predict v_t.

        Args:
            deep: levels of the U-Net that are not computed at every call.
        """
        inputs = [z]
        if self.image != "none":
            inputs.append(to_signed(getattr(condition, self.image)))
        if self.ray_maps:
            rays = condition.cameras.rays(condition.near, condition.near)
            origins = rays.origins / rays.near[..., None]
            inputs.append(torch.cat([origins, rays.directions], -1).movedim(-1, 1))
        context = condition.context if self.cross_attention else ()
        if deep is not None:
            deep.advance()
        output = self.unet(torch.cat(inputs, 1), t, context, deep)[0].float()
        if self.residual_std is None:
            return output
        alpha, sigma = (expand(c, z) for c in alpha_sigma(t))
        mean, scale = gaussian_velocity(z, to_signed(condition.rendered), self.residual_std, alpha, sigma)
        return mean + scale * output

    def forward(
        self,
        z: Float[Tensor, "batch 3 height width"],
        t: Float[Tensor, "batch"],
        condition: Condition,
        deep: DeepFeatures | None = None,
    ) -> Float[Tensor, "batch 3 height width"]:
        """Predict the denoised images x0."""
        alpha, sigma = (expand(c, z) for c in alpha_sigma(t))
        return x0_from_v(z, self.velocity(z, t, condition, deep), alpha, sigma)
