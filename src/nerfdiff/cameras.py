"""One camera convention for the whole project.

OpenCV axes (x right, y down, z forward); `c2w` maps camera to world; `K` is in pixels with pixel centres
at +0.5, so the top-left corner of the image is (0, 0) and its centre is (width / 2, height / 2).
Dataset readers convert into this convention; nothing else knows another one.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from nerfdiff.utils.precision import full_precision


def along_axes(coordinates: Sequence[Float[Tensor, "*points"]]) -> Float[Tensor, "*points axes"]:
    """Points from their coordinates, each axis in one piece of memory: a CPU is slow at rows of three numbers."""
    return torch.stack(list(coordinates)).movedim(0, -1)


@dataclass(frozen=True)
class Rays:
    """Rays with unit directions; `near` and `far` are distances along the ray, in scene units.

    All four share the leading shape `*rays`.
    """

    origins: Float[Tensor, "*rays 3"]
    directions: Float[Tensor, "*rays 3"]
    near: Float[Tensor, "*rays"]
    far: Float[Tensor, "*rays"]

    def at(self, distances: Float[Tensor, "*rays samples"]) -> Float[Tensor, "*rays samples 3"]:
        """Points x_o + t·d (paper, "Image-conditioned NeRF")."""
        axes = zip(self.origins.unbind(-1), self.directions.unbind(-1), strict=True)
        return along_axes([torch.addcmul(o[..., None], distances, d[..., None]) for o, d in axes])


@dataclass(frozen=True)
class Cameras:
    """A batch of pinhole cameras of one image size.

    Args:
        c2w: camera-to-world (or camera-to-source, see `relative_to`) rigid transforms.
        K: intrinsics in pixels, [[fx, 0, cx], [0, fy, cy], [0, 0, 1]].
        height, width: image size in pixels.
    """

    c2w: Float[Tensor, "*batch 4 4"]
    K: Float[Tensor, "*batch 3 3"]
    height: int
    width: int

    @property
    def shape(self) -> torch.Size:
        return self.c2w.shape[:-2]

    def __len__(self) -> int:
        return self.c2w.shape[0]

    def __getitem__(self, index) -> "Cameras":
        """Index the batch axes (not the matrices)."""
        return replace(self, c2w=self.c2w[index], K=self.K[index])

    def to(self, *args, **kwargs) -> "Cameras":
        """Move or cast as `Tensor.to`."""
        return replace(self, c2w=self.c2w.to(*args, **kwargs), K=self.K.to(*args, **kwargs))

    def flatten(self) -> "Cameras":
        """Merge all batch axes into one."""
        return replace(self, c2w=self.c2w.reshape(-1, 4, 4), K=self.K.reshape(-1, 3, 3))

    @staticmethod
    def stack(cameras: Sequence["Cameras"], dim: int = 0) -> "Cameras":
        """Stack cameras of one image size along a new axis.

        Raises:
            ValueError: the image sizes differ.
        """
        sizes = {(c.height, c.width) for c in cameras}
        if len(sizes) != 1:
            raise ValueError(f"cameras to stack must share one image size, got {sorted(sizes)}")
        c2w = torch.stack([c.c2w for c in cameras], dim)
        K = torch.stack([c.K for c in cameras], dim)
        return Cameras(c2w, K, *sizes.pop())

    @staticmethod
    def join(cameras: Sequence["Cameras"]) -> "Cameras":
        """Put cameras of one image size one after the other along their first axis."""
        c2w, K = (torch.cat([getattr(c, name) for c in cameras]) for name in ("c2w", "K"))
        return replace(cameras[0], c2w=c2w, K=K)

    @property
    def centres(self) -> Float[Tensor, "*batch 3"]:
        """Camera centres."""
        return self.c2w[..., :3, 3]

    def relative_to(self, source: "Cameras") -> "Cameras":
        """These cameras in the space of `source` (broadcast over batch axes): the paper's relative poses.

        The source itself becomes the identity; moving the world changes nothing.
        """
        R, centre = source.c2w[..., :3, :3], source.c2w[..., :3, 3:]
        inverse = torch.zeros_like(source.c2w)
        inverse[..., :3, :3] = R.mT
        inverse[..., :3, 3:] = -(R.mT * centre.mT).sum(-1, keepdim=True)
        inverse[..., 3, 3] = 1
        with full_precision(self.c2w.device):
            c2w = inverse @ self.c2w
        return replace(self, c2w=c2w, K=self.K.expand(*c2w.shape[:-2], 3, 3))

    def resized(self, height: int, width: int) -> "Cameras":
        """Cameras of the same view at another resolution (pixel centres at +0.5: K scales without offset)."""
        scale = self.K.new_tensor([width / self.width, height / self.height, 1.0])
        return replace(self, K=self.K * scale[:, None], height=height, width=width)

    def cropped(self, top: int, left: int, height: int, width: int) -> "Cameras":
        """Cameras of the sub-image whose top-left pixel is (`top`, `left`)."""
        offset = self.K.new_zeros(3, 3)
        offset[0, 2], offset[1, 2] = left, top
        return replace(self, K=self.K - offset, height=height, width=width)

    def pixel_centres(self) -> Float[Tensor, "height width 2"]:
        """(u, v) of every pixel centre, row-major."""
        kwargs = {"dtype": self.K.dtype, "device": self.K.device}
        v, u = torch.meshgrid(
            torch.arange(self.height, **kwargs) + 0.5, torch.arange(self.width, **kwargs) + 0.5, indexing="ij"
        )
        return torch.stack([u, v], dim=-1)

    def rays(self, near: Float[Tensor, "*#batch"] | float, far: Float[Tensor, "*#batch"] | float) -> Rays:
        """One ray through every pixel centre: leading shape `*batch height width`."""
        u, v = self.pixel_centres().unbind(-1)
        fx, fy, cx, cy = (self.K[..., i, j, None, None] for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
        x, y = (u - cx) / fx, (v - cy) / fy
        local = torch.stack([x, y, torch.ones_like(x)], dim=-1)
        with full_precision(self.c2w.device):
            directions = torch.einsum("...ij,...hwj->...hwi", self.c2w[..., :3, :3], local)
        directions = directions / directions.norm(dim=-1, keepdim=True)
        origins = self.centres[..., None, None, :].expand_as(directions)
        bounds = [torch.as_tensor(b, dtype=self.K.dtype, device=self.K.device) for b in (near, far)]
        near_far = [b.reshape(*b.shape, 1, 1).expand(directions.shape[:-1]) for b in bounds]
        return Rays(origins, directions, *near_far)

    def project(
        self, points: Float[Tensor, "*#batch n 3"]
    ) -> tuple[Float[Tensor, "*batch n 2"], Float[Tensor, "*batch n"]]:
        """World points (broadcast over batch axes) to (u, v) pixels and depth z.

        Points with z <= 0 give meaningless pixels.
        """
        offsets = points - self.centres[..., None, :]
        with full_precision(self.c2w.device):
            local = torch.einsum("...ji,...nj->...ni", self.c2w[..., :3, :3], offsets)
            uvw = torch.einsum("...ij,...nj->...ni", self.K, local)
        return uvw[..., :2] / uvw[..., 2:], local[..., 2]
