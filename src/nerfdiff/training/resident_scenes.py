"""Keep on the device what training from memory needs: all images, each step's draws, a frozen field's renderings."""

import logging
import math
import time
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int64, UInt8
from torch import Tensor

from nerfdiff.cameras import Cameras
from nerfdiff.data.scene import SceneReader
from nerfdiff.model import NerfDiff
from nerfdiff.utils.errors import ConfigError, DataError
from nerfdiff.utils.randomness import seed_of
from nerfdiff.utils.spread import spread

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class ResidentScenes:
    """All views of scenes that have as many views each, on one device.

    Args:
        pixels: 8-bit colours.
        c2w, K: as `Cameras` has them.
        near, far: bounds of each scene, as distances along rays.
    """

    pixels: UInt8[Tensor, "scenes views 3 height width"]
    c2w: Float[Tensor, "scenes views 4 4"]
    K: Float[Tensor, "scenes views 3 3"]
    near: Float[Tensor, "scenes"]
    far: Float[Tensor, "scenes"]

    @staticmethod
    def read(reader: SceneReader, wanted: int | None, device: torch.device) -> "ResidentScenes":
        """Read scenes spread evenly over a reader.

        Raises:
            DataError: they have different numbers of views.
        """
        scenes = [reader.load(index) for index in spread(len(reader), wanted)]
        if len(counts := {len(scene.views) for scene in scenes}) > 1:
            raise DataError(f"training from memory needs scenes of equally many views, and these have {sorted(counts)}")
        bounds = torch.tensor([[scene.near, scene.far] for scene in scenes], device=device).unbind(1)
        pixels = torch.stack([scene.pixels for scene in scenes]).to(device)
        cameras = Cameras.stack([scene.cameras for scene in scenes]).to(device)
        return ResidentScenes(pixels, cameras.c2w, cameras.K, *bounds)

    def images(self, scene: Int64[Tensor, "*n"], view: Int64[Tensor, "*n"]) -> Float[Tensor, "*n 3 height width"]:
        """Return colours in [0, 1]."""
        return self.pixels[scene, view].float() / 255

    def cameras(
        self, scene: Int64[Tensor, "n"], source: Int64[Tensor, "n"], targets: Int64[Tensor, "n t"]
    ) -> tuple[Cameras, Cameras]:
        """Return the sources' cameras [n], and the targets' [n, t] in their space."""
        size = self.pixels.shape[-2:]
        sources = Cameras(self.c2w[scene, source], self.K[scene, source], *size)
        rows = scene[:, None].expand_as(targets)
        relative = Cameras(self.c2w[rows, targets], self.K[rows, targets], *size).relative_to(sources[:, None])
        identity = torch.zeros_like(sources.c2w)
        identity.diagonal(dim1=-2, dim2=-1).fill_(1)
        return replace(sources, c2w=identity), relative


def draw_table(
    seed: int, draws: int, scenes: int, views: int, targets: int, sources: int, source_as_target: float
) -> Int64[Tensor, "draws columns"]:
    """Draw a scene, a source view and target views for each row, by the rule of `nerfdiff.data.draws.Draws`.

    Raises:
        ConfigError: a scene has too few views.
    """
    if views <= targets:
        raise ConfigError(f"data.target_views={targets} and a source need scenes of more than {views} views")
    rng = torch.Generator().manual_seed(seed_of(seed, "resident draws"))
    passes = [torch.randperm(scenes, generator=rng) for _ in range(math.ceil(draws / scenes))]
    source = torch.randint(min(sources, views), (draws, 1), generator=rng)
    order = torch.rand(draws, views, generator=rng).scatter(1, source, 2.0).argsort(1)[:, :targets]
    again = torch.rand(draws, generator=rng) < source_as_target
    order[:, 0] = torch.where(again, source[:, 0], order[:, 0])
    return torch.cat([torch.cat(passes)[:draws, None], source, order], 1)


class FrozenField:
    """Renderings of all views from some source views of each scene, and what the CDM attends to, made once.

    Args:
        sources: so many first views of a scene.
        batch: source views encoded at once.
        autocast: the context of the forward pass.
        every_seconds: between lines on how far it is.
    """

    @torch.no_grad()
    def __init__(
        self,
        model: NerfDiff,
        scenes: ResidentScenes,
        sources: int,
        batch: int,
        autocast: AbstractContextManager,
        every_seconds: float = math.inf,
    ):
        count, views = scenes.pixels.shape[:2]
        device = scenes.pixels.device
        pairs = torch.cartesian_prod(torch.arange(count), torch.arange(min(sources, views))).to(device)
        everything = torch.arange(views, device=device)
        rendered, context = [], []
        began = said = time.monotonic()
        for number, (scene, source) in enumerate(part.unbind(1) for part in pairs.split(batch)):
            if number and (now := time.monotonic()) - said > every_seconds:
                share = number * batch / len(pairs)
                left = (now - began) * (1 - share) / share
                log.info("renderings of the frozen field: %.0f %% made, %.0f s left", 100 * share, left)
                said = now
            own, all_views = scenes.cameras(scene, source, everything.expand(len(scene), -1))
            with autocast:
                encoding = model.encode_images(scenes.images(scene, source), own, scenes.near[scene], scenes.far[scene])
                rendered.append(model.render(encoding, all_views).images.half())
            context.append(encoding.context)
        shape = (count, min(sources, views))
        self.rendered = torch.cat(rendered).unflatten(0, shape)
        self.context = [torch.cat(level).unflatten(0, shape) for level in zip(*context, strict=True)]
