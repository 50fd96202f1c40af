"""Source and target views of several scenes, each in the space of its source camera."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace

import torch
from jaxtyping import Bool, Float, Int64, UInt8
from torch import Tensor

from nerfdiff.cameras import Cameras
from nerfdiff.data.scene import Scene
from nerfdiff.utils.errors import DataError


@dataclass(frozen=True)
class Sample:
    """An item of a batch: positions of a source and of target views in a scene.

    `draw` is the sample's number within the run; in evaluation, the scene's within its split. `source_shift` moves
    the cameras of those targets that are the source itself, in scene units along the source camera's axes.
    """

    scene: Scene
    source: int
    targets: Sequence[int]
    draw: int
    source_shift: tuple[float, float, float] | None = None


@dataclass
class ViewBatch:
    """B samples: one source view and T target views of one scene each.

    Images stay 8-bit until they are used, which makes a quarter of the bytes to move to the device.

    Args:
        draws: each sample's `draw`, which seeds whatever noise the sample needs.
        source_pixels, target_pixels: 8-bit colours.
        source_cameras: [B]; `c2w` is the identity.
        target_cameras: [B, T]; relative to the source camera.
        near, far: bounds as distances along rays, in scene units.
        scene_ids: B names.
        source_views, target_views: names of the views within their scenes.
        target_depth: ground-truth z-depth, 0 where nothing was hit; None where unknown or not asked for.
        target_mask: ground-truth foreground; None where unknown or not asked for.
        soft_pixels: the source before it was sharpened (`nerfdiff.stability.mend`); None where it was not.
    """

    draws: Int64[Tensor, " batch"]
    source_pixels: UInt8[Tensor, "batch 3 height width"]
    source_cameras: Cameras
    target_pixels: UInt8[Tensor, "batch targets 3 height width"]
    target_cameras: Cameras
    near: Float[Tensor, " batch"]
    far: Float[Tensor, " batch"]
    scene_ids: tuple[str, ...]
    source_views: tuple[str, ...]
    target_views: tuple[tuple[str, ...], ...]
    target_depth: Float[Tensor, "batch targets height width"] | None = None
    target_mask: Bool[Tensor, "batch targets height width"] | None = None
    soft_pixels: UInt8[Tensor, "batch 3 height width"] | None = None

    @staticmethod
    def collate(samples: Sequence[Sample]) -> "ViewBatch":
        """Batch samples, and put their cameras into the space of their sources.

        Raises:
            DataError: image sizes differ.
            RuntimeError: the numbers of targets differ.
        """
        scenes = [sample.scene for sample in samples]
        sizes = {tuple(scene.pixels.shape[-2:]) for scene in scenes}
        if len(sizes) > 1:
            raise DataError(f"scenes of a batch need images of one size, not {sorted(sizes)}; set data.image_size")
        sources = Cameras.stack([sample.scene.cameras[sample.source] for sample in samples])
        targets = Cameras.stack([sample.scene.cameras[list(sample.targets)] for sample in samples])

        def of_targets(values: Sequence[Tensor | None]) -> Tensor | None:
            if any(value is None for value in values):
                return None
            return torch.stack([value[list(s.targets)] for value, s in zip(values, samples, strict=True)])

        return ViewBatch(
            draws=torch.tensor([sample.draw for sample in samples]),
            source_pixels=torch.stack([sample.scene.pixels[sample.source] for sample in samples]),
            # exactly the identity, where R·Rᵀ of a pose from a text file only nearly is
            source_cameras=replace(sources, c2w=torch.eye(4).repeat(len(samples), 1, 1)),
            target_pixels=of_targets([scene.pixels for scene in scenes]),
            target_cameras=_shifted(targets.relative_to(sources[:, None]), samples),
            near=torch.tensor([scene.near for scene in scenes]),
            far=torch.tensor([scene.far for scene in scenes]),
            scene_ids=tuple(scene.id for scene in scenes),
            source_views=tuple(sample.scene.views[sample.source] for sample in samples),
            target_views=tuple(tuple(s.scene.views[t] for t in s.targets) for s in samples),
            target_depth=of_targets([scene.depth for scene in scenes]),
            target_mask=of_targets([scene.mask for scene in scenes]),
        )

    def __len__(self) -> int:
        return self.draws.shape[0]

    @property
    def source(self) -> Float[Tensor, "batch 3 height width"]:
        """Source colours in [0, 1]."""
        return self.source_pixels.float() / 255

    @property
    def targets(self) -> Float[Tensor, "batch targets 3 height width"]:
        """Target colours in [0, 1]."""
        return self.target_pixels.float() / 255

    def to(self, device: torch.device | str, non_blocking: bool | None = None) -> "ViewBatch":
        """Move all tensors but the draws, which seed what the host draws; by default without waiting where that is
        safe, which is on the way to CUDA."""
        if non_blocking is None:
            non_blocking = torch.device(device).type == "cuda"
        return replace(self._map(lambda tensor: tensor.to(device, non_blocking=non_blocking)), draws=self.draws)

    def pin_memory(self) -> "ViewBatch":
        """Copy to page-locked memory; `DataLoader` calls this."""
        return self._map(Tensor.pin_memory)

    def _map(self, function: Callable[[Tensor], Tensor]) -> "ViewBatch":
        changes = {}
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, Cameras):
                changes[field.name] = replace(value, c2w=function(value.c2w), K=function(value.K))
            elif isinstance(value, Tensor):
                changes[field.name] = function(value)
        return replace(self, **changes)


def _shifted(relative: Cameras, samples: Sequence[Sample]) -> Cameras:
    """Cameras [samples, targets] relative to their sources, with the sources' own copies moved."""
    c2w = relative.c2w.clone()
    for k, sample in enumerate(samples):
        if sample.source_shift is not None:
            own = [position for position, target in enumerate(sample.targets) if target == sample.source]
            c2w[k, own, :3, 3] += torch.tensor(sample.source_shift)
    return replace(relative, c2w=c2w)
