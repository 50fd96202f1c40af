"""Geometry of a whole scene: density where the true silhouettes show that nothing is, and planes facing the camera."""

from dataclasses import replace

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from nerfdiff.cameras import Cameras, Rays
from nerfdiff.field.field import Field
from nerfdiff.render.renderer import Renderer


def outside_hull(
    points: Float[Tensor, "n 3"], cameras: Cameras, silhouettes: Bool[Tensor, "views h w"]
) -> Bool[Tensor, "n"]:
    """Return true where some camera [views] that has a point in its image sees background there.

    The visual hull is what is left; where no camera looks, nothing is known and nothing is outside.
    """
    outside = torch.zeros(len(points), dtype=torch.bool, device=points.device)
    for camera, silhouette in zip(range(len(cameras)), silhouettes, strict=True):
        pixels, z = cameras[camera].project(points)
        # Cast only what is in the image: before the camera plane, pixels are meaningless, perhaps infinite.
        u, v = pixels.unbind(-1)
        seen = (z > 0) & (u >= 0) & (u < cameras.width) & (v >= 0) & (v < cameras.height)
        outside[seen] |= ~silhouette[v[seen].long(), u[seen].long()]
    return outside


@torch.no_grad()
def floaters(
    field: Field,
    renderer: Renderer,
    cameras: Cameras,
    silhouettes: Bool[Tensor, "views h w"],
    near: float,
    far: float,
    rays: int,
    margin: int,
    invisible: float,
    generator: torch.Generator,
) -> float | None:
    """Share of what the cameras see of a field that lies outside the visual hull of the true silhouettes: 0 is ideal.

    Σ ω_i [x_i outside] / Σ ω_i over samples x_i of random rays of all views, ω_i being the weights that composite
    their colours. Weighing by what is seen, and not by volume, keeps the number free of a grid and of how full the
    unseen insides of objects are. Floaters before the object count where they cover it and, from other views, where
    they stand beside it; white ones count too, though a white background hides them.

    Args:
        cameras, silhouettes: true views [views], in the space of the field, and what is not background in them.
        near, far: of the rays, in scene units.
        rays: drawn without replacement; all where there are no more.
        margin: pixels that silhouettes are widened by; they cut through the pixels of an edge.
        invisible: density that dims a ray by less than this between near and far is not worth looking up.
        generator: of the draw, on the device of everything.

    Returns:
        in [0, 1]; None where no view has background (there is no hull), or where nothing of the field is seen.
    """
    if silhouettes.all():
        return None
    widened = F.max_pool2d(silhouettes[:, None].float(), 2 * margin + 1, stride=1, padding=margin)[:, 0] > 0

    def outside(points: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        """The field, with "is outside" as its colour."""
        _, density = field(points, directions)
        visible = density * (far - near) > invisible
        flags = torch.zeros_like(density)
        flags[visible] = outside_hull(points[visible], cameras, widened).to(flags)
        return flags[..., None].expand(points.shape), density

    all_rays = cameras.rays(near, far)
    count = all_rays.near.numel()
    picked = torch.randperm(count, generator=generator, device=generator.device)[:rays]
    parts = (part.reshape(1, count, *part.shape[3:])[:, picked] for part in vars(all_rays).values())
    seen = replace(renderer, background=0.0).render(outside, Rays(*parts))
    mass = seen.opacity.double().sum()
    return None if mass <= invisible * len(picked) else float(seen.rgb[..., 0].double().sum() / mass)


def heights(
    depth: Float[Tensor, "views h w"], covered: Bool[Tensor, "views h w"], cameras: Cameras
) -> Float64[Tensor, "n"]:
    """z, in the space that the cameras [views] are given in, of the surface that their covered pixels see.

    Args:
        depth: along each camera's own z.
    """
    u, v = cameras.pixel_centres().double().unbind(-1)
    fx, fy, cx, cy = (cameras.K[..., i, j, None, None].double() for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    local = torch.stack(torch.broadcast_tensors((u - cx) / fx, (v - cy) / fy, torch.ones_like(fx)), -1)
    axis = cameras.c2w[:, None, None, 2].double()
    return ((local * axis[..., :3]).sum(-1) * depth.double() + axis[..., 3])[covered]


def depth_extent(
    depth: Float[Tensor, "views h w"],
    opacity: Float[Tensor, "views h w"],
    truth: Float[Tensor, "views h w"],
    cameras: Cameras,
    threshold: float,
    tails: float,
) -> float | None:
    """Extent of the visible surface along the input camera's axis, over that of the true one: 1 is ideal.

    A plane facing the input camera has 0, however well it looks from there. The extent is the range of z of the
    points that all views see, without the lowest and the highest `tails` of them.

    Args:
        depth, truth: along each view's own z; the latter 0 where nothing was hit.
        cameras: [views], in the input camera's space.
        threshold: opacity above which a pixel sees a surface.
        tails: share of the points left out at either end.

    Returns:
        None where nothing is seen in either, or the true surface has no extent.
    """
    surfaces = heights(depth, opacity > threshold, cameras), heights(truth, truth > 0, cameras)
    if not all(map(len, surfaces)):
        return None
    low, high = np.stack([np.quantile(z.cpu().numpy(), (tails, 1 - tails)) for z in surfaces], -1)
    extent, true_extent = high - low
    return float(extent / true_extent) if true_extent > 0 else None
