"""The field that is fine-tuned at test time: triplane and decoder as parameters, in the input camera's space."""

import copy

import torch
from torch import Tensor, nn

from nerfdiff.cameras import Cameras
from nerfdiff.field.decoder import Decoder
from nerfdiff.field.field import TriplaneField
from nerfdiff.field.triplane import Triplane
from nerfdiff.render.renderer import Renderer, Rendering


class RefinedField(nn.Module):
    """W and f_θ of one scene, copied, so that fitting them changes nothing else.

    Args:
        triplane: of a batch of one scene.
    """

    def __init__(self, triplane: Triplane, decoder: Decoder):
        super().__init__()
        self.planes = nn.Parameter(triplane.planes.detach().float().clone())
        self.decoder = copy.deepcopy(decoder).float().requires_grad_(True).train()
        self._size = triplane.cameras.height, triplane.cameras.width
        # the frustum moves with the module, and is no part of what is fitted
        for name, value in (("K", triplane.cameras.K), ("near", triplane.near), ("far", triplane.far)):
            self.register_buffer(name, value.clone(), persistent=False)

    @property
    def cameras(self) -> Cameras:
        """The input camera [1], in whose space points are given."""
        return Cameras(torch.eye(4, device=self.K.device)[None], self.K, *self._size)

    def field(self) -> TriplaneField:
        """Colour and density of points in the input camera's space."""
        return TriplaneField(Triplane(self.planes, self.cameras, self.near, self.far), self.decoder)

    def render(self, renderer: Renderer, cameras: Cameras) -> Rendering:
        """Whole images of cameras [1, views]: leading shape [1, views, height, width]."""
        return renderer.render_views(self.field(), cameras, self.near, self.far)

    def snapshot(self) -> dict[str, Tensor]:
        """A copy of the parameters, to return to with `load_state_dict`."""
        return {name: value.clone() for name, value in self.state_dict().items()}

    def is_finite(self) -> bool:
        """Whether every parameter is a number."""
        return all(bool(torch.isfinite(parameter).all()) for parameter in self.parameters())
