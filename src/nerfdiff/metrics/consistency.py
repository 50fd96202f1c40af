"""Do views of a scene agree with each other? One field is fitted to half of them and scored on the other half."""

import hashlib
import math
from dataclasses import dataclass, field

import torch
from jaxtyping import Int64, UInt8
from torch import Tensor

from nerfdiff.cameras import Cameras
from nerfdiff.field.decoder import Decoder
from nerfdiff.field.triplane import Triplane
from nerfdiff.fit.inner_steps import InnerSteps
from nerfdiff.fit.ray_batches import RayBatches
from nerfdiff.fit.refined_field import RefinedField
from nerfdiff.metrics.image import dequantise, psnr
from nerfdiff.render.renderer import Renderer
from nerfdiff.utils.randomness import generator


def evenly(count: int, limit: int) -> Int64[Tensor, "used"]:
    """Positions of at most `limit` of `count` things, the first and the last among them."""
    return torch.linspace(0, count - 1, min(count, limit)).round().long()


@dataclass(frozen=True)
class Consistency:
    """PSNR of every other view as predicted by a fresh field that was fitted to the views between.

    Views of one and the same scene score high whether or not it is the true scene; views made independently do not.
    Blurred views score higher still, having less to predict, so a number says little without `sharpness` beside it and
    that of the true views, which is what sharp views that agree can reach with as many views.

    Args:
        scenes: how many of the first scenes to measure; None measures all, 0 none.
        views: at most this many views of a scene, evenly spread.
        steps: of Adam.
        rays: per step.
        lr: learning rate of planes and decoder at the start; it falls to 0 along a cosine.
        plane_size, channels, hidden: of the field.
        initial_std: of the planes.
        density_shift, density_scale: of the decoder.
        uniform_samples, importance_samples: per ray.
        background: grey level behind the scene; None where it has a real one.
        chunk: points per evaluation of the field.
        seed: of the field's beginning and the rays; the same for all views that are compared.
    """

    scenes: int | None
    views: int
    steps: int
    rays: int
    lr: float
    plane_size: int
    channels: int
    hidden: int
    initial_std: float
    density_shift: float
    density_scale: float
    uniform_samples: int
    importance_samples: int
    background: float | None
    chunk: int
    seed: int
    _known: dict[str, float | None] = field(default_factory=dict, init=False, repr=False, compare=False)

    def measures(self, number: int) -> bool:
        """Return true if scene `number` is one of those to measure."""
        return self.scenes is None or number < self.scenes

    def measure_truth(
        self,
        pixels: UInt8[Tensor, "views 3 h w"],
        scene_id: str,
        cameras: Cameras,
        source: Cameras,
        near: float,
        far: float,
    ) -> float | None:
        """`measure` of the true views, remembered: every strategy of a run is compared with the same ones."""
        content = (tensor.cpu().numpy().tobytes() for tensor in (pixels, cameras.c2w, cameras.K, source.K))
        key = hashlib.sha256(b"".join((scene_id.encode(), *content))).hexdigest()
        if key not in self._known:
            self._known[key] = self.measure(pixels, scene_id, cameras, source, near, far)
        return self._known[key]

    def measure(
        self,
        pixels: UInt8[Tensor, "views 3 h w"],
        scene_id: str,
        cameras: Cameras,
        source: Cameras,
        near: float,
        far: float,
    ) -> float | None:
        """Mean PSNR of the held-out views in dB; None of fewer than two views.

        Args:
            scene_id: with `seed`, what the field's beginning and the rays depend on.
            cameras: [views], in the space of the input camera `source` [1], whose frustum the field is aligned with.
            near, far: of the scene.
        """
        count = len(pixels)
        if count < 2:
            return None
        used = evenly(count, self.views)
        fitted, held_out = used[::2], used[1::2]
        device = pixels.device
        bounds = [torch.tensor([value], device=device, dtype=torch.float32) for value in (near, far)]
        fresh = self._fresh(source, *bounds, (self.seed, "consistency", scene_id))
        renderer = Renderer(self.uniform_samples, self.importance_samples, self.background, self.chunk)
        batches = RayBatches(cameras[fitted][None], *bounds)
        batches.set_colours(dequantise(pixels[fitted])[None])
        with torch.enable_grad():
            self._fit(fresh, renderer, batches, generator(device, self.seed, "consistency", scene_id, "rays"))
        with torch.no_grad():
            rendered = fresh.render(renderer, cameras[held_out][None]).images[0]
        return psnr(rendered.clamp(0, 1), dequantise(pixels[held_out])).mean().item()

    def _fresh(self, source: Cameras, near: Tensor, far: Tensor, seed: tuple[int | str, ...]) -> RefinedField:
        """A field that knows nothing; drawn on the CPU, so that devices agree."""
        draws = generator("cpu", *seed, "field")
        planes = torch.randn(1, 3, self.channels, self.plane_size, self.plane_size, generator=draws)
        with torch.random.fork_rng(devices=[]):  # which PyTorch's own beginning would advance
            decoder = Decoder(self.channels, self.hidden, self.density_shift, self.density_scale)
        with torch.no_grad():
            for layer in (decoder.hidden, decoder.output):
                bound = 1 / math.sqrt(layer.in_features)  # PyTorch's own, but from our generator
                for parameter in layer.parameters():
                    parameter.uniform_(-bound, bound, generator=draws)
        frustum = Triplane((self.initial_std * planes).to(near.device), source, near, far)
        return RefinedField(frustum, decoder.to(near.device))

    def _fit(self, fresh: RefinedField, renderer: Renderer, batches: RayBatches, rays: torch.Generator) -> None:
        optimizer = torch.optim.Adam(fresh.parameters(), lr=self.lr, fused=True)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, max(self.steps, 1))
        inner = InnerSteps(fresh, renderer, batches, optimizer, self.rays, [rays], record=False)
        for _ in range(self.steps):
            inner.run(1)
            schedule.step()
