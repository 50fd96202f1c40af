"""Do the views' depths and colours describe one surface?"""

from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import max_pool2d

from nerfdiff.data.scene import Scene
from nerfdiff.inspection.bounds import ray_distance
from nerfdiff.inspection.check import Finding
from nerfdiff.utils.spread import spread


@dataclass(frozen=True)
class DepthAgreement:
    """Points that one view sees are carried to the others, which must see them or something nearer.

    A point counts as seen by another view where its depth lies within those of the 3×3 pixels around it, which
    allows for slanted surfaces; as hidden where they are nearer; and as contradicted where that view sees through it.

    Args:
        views: of a scene that are compared, every one with every other.
        pixels: of each view that are carried over.
        tolerance: of the comparison, relative to depth.
        min_agreement: share of the points seen or contradicted that must be seen.
        min_seen: share of all points that some other view must see, so that nothing is not agreement.
        max_colour: mean difference of a seen point's two colours over that of two points at random.
        seed: of the pixels.
    """

    views: int
    pixels: int
    tolerance: float
    min_agreement: float
    min_seen: float
    max_colour: float
    seed: int
    tolerated: float

    measures: ClassVar[str] = "share of visible points on which two views' depths agree"
    higher_is_better: ClassVar[bool] = True
    judges_cameras: ClassVar[bool] = True
    matches_images: ClassVar[bool] = True
    tells_focal: ClassVar[bool] = True
    fallback: ClassVar[bool] = False

    def __call__(self, scene: Scene) -> Finding:
        if scene.depth is None:
            return Finding.unchecked("the data have no depth")
        if len(scene.views) < 2:
            return Finding.unchecked("a scene needs two views")
        views = spread(len(scene.views), self.views)
        depth = scene.depth[views].double()
        if not (depth > 0).any():
            return Finding.unchecked("no pixel has depth")
        counts, colours = self._compare(scene, views, depth)
        points, seen, contradicted = counts.tolist()
        agreement = seen / max(seen + contradicted, 1)
        if seen < self.min_seen * points:
            return Finding.judged(
                agreement, f"other views see only {seen / points:.1%} of the points that one view's depth gives"
            )
        if agreement < self.min_agreement:
            return Finding.judged(
                agreement, f"views disagree on depth: only {agreement:.1%} of the visible points are where they say"
            )
        error = colour_error(*colours, seed=self.seed)
        reason = None
        if error > self.max_colour:
            reason = (
                f"depths agree, but colours do not belong to them: a point's colours in two views differ "
                f"{error:.2f} times as much as those of two points at random"
            )
        return Finding.judged(agreement, reason)

    def _compare(
        self, scene: Scene, views: list[int], depth: Float[Tensor, "views h w"]
    ) -> tuple[Float[Tensor, "3"], tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]]:
        """(points, seen, contradicted), and the colours of seen points here and there."""
        cameras, images = scene.cameras[views].to(torch.float64), scene.pixels[views].float() / 255
        height, width = cameras.height, cameras.width
        hit = depth > 0
        beyond = torch.where(hit, depth, torch.inf)
        nearest, farthest = -_largest_around(-beyond), _largest_around(beyond)
        nearest = torch.where(_largest_around(hit.double()) > 0, nearest, torch.inf)
        rays = cameras.rays(0.0, 0.0)
        surface = rays.origins + rays.directions * ray_distance(depth, cameras)[..., None]
        generator = torch.Generator().manual_seed(self.seed)
        counts, here, there = depth.new_zeros(3), [], []
        for view in range(len(views)):
            pixels = hit[view].nonzero()
            pixels = pixels[torch.randperm(len(pixels), generator=generator)[: self.pixels]]
            others = [other for other in range(len(views)) if other != view]
            uv, z = cameras[others].project(surface[view][pixels[:, 0], pixels[:, 1]][None])
            x, y = uv.nan_to_num(-1, -1, -1).clamp(-1, max(height, width)).floor().long().unbind(-1)
            inside = (z > 0) & (x >= 0) & (x < width) & (y >= 0) & (y < height)
            at = (torch.tensor(others)[:, None].expand_as(x), y.clamp(0, height - 1), x.clamp(0, width - 1))
            through = inside & (z < nearest[at] - self.tolerance * z)
            seen = inside & ~through & (z <= farthest[at] + self.tolerance * z) & nearest[at].isfinite()
            counts += torch.tensor([z.numel(), seen.sum(), through.sum()])
            exact = seen & ((depth[at] - z).abs() <= self.tolerance * z)  # colours of other surfaces stay out
            here.append(images[view][:, pixels[:, 0], pixels[:, 1]].T.expand(len(others), -1, -1)[exact])
            there.append(images[at[0], :, at[1], at[2]][exact])
        return counts, (torch.cat(here), torch.cat(there))


def _largest_around(values: Float[Tensor, "views h w"]) -> Float[Tensor, "views h w"]:
    return max_pool2d(values[:, None], 3, stride=1, padding=1)[:, 0]


def colour_error(here: Float[Tensor, "n 3"], there: Float[Tensor, "n 3"], seed: int) -> float:
    """Mean difference of the rows over that of rows paired at random; 0 where all have one colour."""
    if not len(here):
        return 0.0
    shuffled = there[torch.randperm(len(there), generator=torch.Generator().manual_seed(seed))]
    chance = (here - shuffled).abs().mean().item()
    return (here - there).abs().mean().item() / chance if chance > 1e-2 else 0.0
