"""Coordinates of the input camera's frustum, in which every field is defined."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from nerfdiff.cameras import Cameras, along_axes


def frustum_coordinates(
    points: Float[Tensor, "batch n 3"],
    cameras: Cameras,
    near: Float[Tensor, "batch"],
    far: Float[Tensor, "batch"],
) -> tuple[Float[Tensor, "batch n 3"], Bool[Tensor, "batch n"]]:
    """Return x̃ = [P(x), 2 (x_z − t_n) / (t_f − t_n) − 1], and true where the point is beyond the near plane.

    x̃ is in [-1, 1]³ inside the frustum; -1 and 1 are the outer edges of the border pixels. Points before
    t_n are masked before the division: behind the camera they would project to mirrored features.

    Args:
        points: in the space of `cameras` [batch], whose `c2w` plays no part.
        near, far: t_n and t_f.
    """
    near, far = near[:, None], far[:, None]
    x, y, z = points.unbind(-1)
    valid = z >= near
    before = torch.where(valid, z, 1.0)
    fx, fy, cx, cy = (cameras.K[:, i, j, None] for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    u, v = fx * x / before + cx, fy * y / before + cy
    projected = [2 * u / cameras.width - 1, 2 * v / cameras.height - 1]
    depth = 2 * (z - near) / (far - near) - 1
    coordinates = [torch.where(valid, coordinate, 0.0) for coordinate in (*projected, depth)]
    return along_axes(coordinates), valid
