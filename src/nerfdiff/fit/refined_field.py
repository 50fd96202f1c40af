"""The field that is fine-tuned at test time: triplane and decoder as parameters, in the input camera's space."""

import torch
from jaxtyping import Bool
from torch import Tensor, nn

from nerfdiff.cameras import Cameras
from nerfdiff.field.decoder import Decoder
from nerfdiff.field.field import TriplaneField
from nerfdiff.field.triplane import Triplane
from nerfdiff.render.renderer import RenderedViews, Renderer


class RefinedField(nn.Module):
    """Hold copies of W and f_θ of one scene, or of several with a decoder each, as parameters to fit.

    Args:
        triplane: of a batch of scenes.
    """

    def __init__(self, triplane: Triplane, decoder: Decoder):
        super().__init__()
        self.planes = nn.Parameter(triplane.planes.detach().float().clone())
        self.decoder = decoder.for_scenes(len(self.planes)).float().requires_grad_(True).train()
        self._size = triplane.cameras.height, triplane.cameras.width
        # the frustum moves with the module, and is no part of what is fitted
        for name, value in (("K", triplane.cameras.K), ("near", triplane.near), ("far", triplane.far)):
            self.register_buffer(name, value.clone(), persistent=False)

    def __len__(self) -> int:
        return len(self.planes)

    @property
    def cameras(self) -> Cameras:
        """Input cameras [scenes], in whose space points are given."""
        return Cameras(torch.eye(4, device=self.K.device).expand(len(self), 4, 4), self.K, *self._size)

    @property
    def triplane(self) -> Triplane:
        """The triplane W."""
        return Triplane(self.planes, self.cameras, self.near, self.far)

    def field(self) -> TriplaneField:
        """Return the radiance field, in the input camera's space."""
        return TriplaneField(self.triplane, self.decoder)

    def render(self, renderer: Renderer, cameras: Cameras, keep_coarse: bool = False) -> RenderedViews:
        """Render whole images of cameras [scenes, views].

        Args:
            keep_coarse: as `Renderer.render`'s.
        """
        return renderer.render_views(self.field(), cameras, self.near, self.far, keep_coarse=keep_coarse)

    def alone(self, scene: int) -> "RefinedField":
        """Return a copy of one scene's field."""
        own = slice(scene, scene + 1)
        triplane = Triplane(self.planes[own], self.cameras[own], self.near[own], self.far[own])
        return RefinedField(triplane, self.decoder.of_scene(scene))

    @torch.no_grad()
    def snapshot(self) -> dict[str, Tensor]:
        """Return a copy of the parameters, for `restore`."""
        return {name: value.detach().clone() for name, value in self.named_parameters()}

    @torch.no_grad()
    def restore(self, snapshot: dict[str, Tensor], scenes: Bool[Tensor, "scenes"]) -> None:
        """Set the parameters of those scenes to the snapshot's."""
        chosen = choose(scenes, snapshot, self.snapshot())
        for name, value in self.named_parameters():
            value.copy_(chosen[name])

    def finite(self) -> Bool[Tensor, "scenes"]:
        """Return true for each scene whose parameters are all finite."""
        return torch.stack([torch.isfinite(value).reshape(len(self), -1).all(1) for value in self.parameters()]).all(0)


def choose(scenes: Bool[Tensor, "scenes"], snapshot: dict[str, Tensor], other: dict[str, Tensor]) -> dict[str, Tensor]:
    """Take one snapshot's parameters for those scenes, another's for the rest, without waiting for the device."""
    # a parameter's first axis is the scenes' where there are several
    flags = {name: scenes.reshape(-1, *[1] * (value.ndim - 1)) for name, value in snapshot.items()}
    return {name: torch.where(flags[name], value, other[name]) for name, value in snapshot.items()}
