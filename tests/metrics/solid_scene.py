"""Balls that are seen from all around, with every picture, silhouette and depth in closed form."""

import torch

from model_fixtures import look_at
from nerfdiff.cameras import Cameras, Rays

CENTRE = (0.0, 0.0, 1.3)
NEAR, FAR = 0.7, 1.9


def ring(count, size=32, heights=(0.0,)):
    """Cameras on a circle about the y axis through CENTRE; the first, at height 0, is the input camera."""
    poses = []
    for k in range(count):
        angle = torch.tensor(2 * torch.pi * k / count)
        y = heights[k % len(heights)]
        radius = (1.3**2 - y**2) ** 0.5
        poses.append(look_at((float(radius * angle.sin()), y, float(1.3 - radius * angle.cos())), CENTRE))
    K = torch.tensor([[1.1 * size, 0, size / 2], [0, 1.1 * size, size / 2], [0, 0, 1]])
    return Cameras(torch.stack(poses), K.repeat(count, 1, 1), size, size)


def ball_distance(rays: Rays, centre, radius):
    """Distance along each ray to the ball's surface; infinite where it passes."""
    offset = rays.origins - torch.tensor(centre)
    along = (offset * rays.directions).sum(-1)
    root = along.square() - offset.square().sum(-1) + radius**2
    return torch.where(root >= 0, -along - root.clamp_min(0).sqrt(), torch.inf)


def balls(*parts, density=1000.0):
    """A field of solid balls (centre, radius), coloured by where they are."""

    def field(points, directions=None):
        inside = torch.zeros(points.shape[:-1], dtype=torch.bool)
        for centre, radius in parts:
            inside |= (points - torch.tensor(centre)).norm(dim=-1) < radius
        return colour(points), inside * density

    return field


def colour(points):
    """Waves across the ball: no two sides of it look alike."""
    return 0.5 + 0.5 * torch.sin(points * torch.tensor([8.0, 11.0, 9.0]) + torch.tensor([0.0, 1.0, 2.0]))


def pictures(cameras, radius=0.35):
    """8-bit pictures [views, 3, h, w] of one ball on white, and its z-depth, 0 where it is not."""
    rays = cameras.rays(NEAR, FAR)
    distance = ball_distance(rays, CENTRE, radius)
    hit = distance.isfinite()
    points = rays.at(torch.where(hit, distance, 0.0)[..., None])[..., 0, :]
    images = torch.where(hit[..., None], colour(points), 1.0).movedim(-1, 1)
    local = torch.einsum("vji,vhwj->vhwi", cameras.c2w[:, :3, :3], points - cameras.centres[:, None, None])
    return (255 * images).round().to(torch.uint8), torch.where(hit, local[..., 2], 0.0)
