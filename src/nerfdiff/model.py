"""NerfDiff: the single-image NeRF and the CDM, side by side, free of any training framework."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Float
from omegaconf import DictConfig
from torch import Tensor, nn

from nerfdiff.cameras import Cameras
from nerfdiff.data.batch import ViewBatch
from nerfdiff.diffusion.denoiser import Condition, Denoiser
from nerfdiff.field.encoder import Encoding
from nerfdiff.field.field import Field
from nerfdiff.field.kinds import TRIPLANE, field_kind, to_record
from nerfdiff.render.renderer import RenderedViews, Renderer
from nerfdiff.utils.config import plain
from nerfdiff.utils.errors import ConfigError
from nerfdiff.utils.timing import timed


class NerfDiff(nn.Module):
    """Encoder e_ψ, decoder f_θ, renderer and CDM ε_φ.

    Args:
        name: of the size, for records.
        unet: sizes shared by the encoder and the CDM ("the image encoder retains the same architecture").
        field: `name` of the single-image NeRF, a triplane where it is not given, and its settings (`field_kind`).
        render: the `Renderer`'s settings.
        conditioning: `image`, `ray_maps`, `cross_attention`, `residual_std` of the CDM, and a `name` for records.

    Raises:
        ConfigError: sizes that cannot be, or a CDM that attends to features which the encoder does not have.
    """

    def __init__(self, name: str, unet: Mapping, field: Mapping, render: Mapping, conditioning: Mapping):
        super().__init__()
        self.name = name
        conditioning = dict(conditioning)
        self.conditioning = conditioning.pop("name")
        self.field_name, self.kind = field.get("name", TRIPLANE), field_kind(field)
        if conditioning["cross_attention"] and not self.kind.has_context:
            raise ConfigError(
                f"field={self.field_name} has no U-Net features to attend to: set conditioning.cross_attention=false"
            )
        self.encoder, self.decoder = self.kind.networks(unet)
        self.renderer = Renderer(**render)
        self.denoiser = Denoiser(**conditioning, unet=unet)

    def encode(self, batch: ViewBatch) -> Encoding:
        """Encode a batch's source views, see `encode_images`."""
        return self.encode_images(batch.source, batch.source_cameras, batch.near, batch.far)

    @timed("encode")
    def encode_images(
        self,
        source: Float[Tensor, "batch 3 height width"],
        cameras: Cameras,
        near: Float[Tensor, "batch"],
        far: Float[Tensor, "batch"],
    ) -> Encoding:
        """Encode input images in [0, 1]: a field's features, and the features that the CDM attends to."""
        return self.encoder(source, cameras, near, far)

    def with_keys_values(self, encoding: Encoding) -> Encoding:
        """Replace the context by its keys and values, for many calls of the CDM: they depend neither on the view nor
        on the diffusion step."""
        keys_values = self.denoiser.unet.keys_values(encoding.context) if self.denoiser.cross_attention else []
        return replace(encoding, context=keys_values)

    def field(self, encoding: Encoding) -> Field:
        """Return the radiance field of each scene."""
        return self.kind.field(encoding.features, self.decoder)

    def render(
        self,
        encoding: Encoding,
        cameras: Cameras,
        jitter: Float[Tensor, "batch n samples"] | None = None,
    ) -> RenderedViews:
        """Render views [batch, views] given in the input cameras' space."""
        frustum = encoding.features
        return self.renderer.render_views(self.field(encoding), cameras, frustum.near, frustum.far, jitter)

    def condition(
        self, encoding: Encoding, cameras: Cameras, rendered: Float[Tensor, "batch views 3 height width"]
    ) -> Condition:
        """Return the CDM's condition for views [batch, views] rendered in [0, 1], flattened into one axis."""
        views = cameras.shape[1]
        return Condition(
            rendered=rendered.flatten(0, 1),
            source=encoding.source[:, None].expand(-1, views, -1, -1, -1).flatten(0, 1),
            cameras=cameras.flatten(),
            near=encoding.features.near.repeat_interleave(views),
            context=encoding.context,
        )

    def parameter_count(self) -> dict[str, int]:
        """Return the number of parameters of each part and in all."""
        parts = {
            part: sum(p.numel() for p in getattr(self, part).parameters())
            for part in ("encoder", "decoder", "denoiser")
        }
        return parts | {"total": sum(parts.values())}


def settings_of(cfg: DictConfig) -> dict[str, Any]:
    """The arguments of `NerfDiff` in a training config, as checkpoints hold them."""
    model = plain(cfg.model)
    return model | {"field": to_record(model["field"]), "conditioning": plain(cfg.conditioning)}


def build_on_meta(config: Mapping) -> NerfDiff:
    """Build the model on the meta device: shapes and counts without memory."""
    with torch.device("meta"):
        return NerfDiff(**config)
