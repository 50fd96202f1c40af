"""Source and target views of several scenes, each in the space of its source camera."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace

import torch
from jaxtyping import Bool, Float, Int64, UInt8
from torch import Tensor

from nerfdiff.cameras import Cameras
from nerfdiff.data.scene import Scene


@dataclass
class ViewBatch:
    """B samples: one source view and T target views of one scene each.

    Images stay 8-bit until they are used, which makes a quarter of the bytes to move to the device.

    Args:
        draws: number of each sample within the run (in evaluation: of the scene within its split); seeds
            whatever noise the sample needs.
        source_pixels, target_pixels: 8-bit colours on white.
        source_cameras: [B]; `c2w` is the identity.
        target_cameras: [B, T]; relative to the source camera.
        near, far: bounds as distances along rays, in scene units.
        scene_ids: B names.
        source_views, target_views: names of the views within their scenes.
        target_depth: ground-truth z-depth, 0 where nothing was hit; None where unknown or not asked for.
        target_mask: ground-truth foreground; None where unknown or not asked for.
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

    @staticmethod
    def from_scene(scene: Scene, source: int, targets: Sequence[int], draw: int) -> "ViewBatch":
        """A batch of one sample from positions among the scene's views."""
        index = torch.as_tensor(targets)
        source_camera = scene.cameras[source]
        return ViewBatch(
            draws=torch.tensor([draw]),
            source_pixels=scene.pixels[source][None],
            # exactly the identity, where R·Rᵀ of a pose from a text file only nearly is
            source_cameras=replace(source_camera, c2w=torch.eye(4)[None], K=source_camera.K[None]),
            target_pixels=scene.pixels[index][None],
            target_cameras=scene.cameras[index].relative_to(source_camera)[None],
            near=torch.tensor([scene.near]),
            far=torch.tensor([scene.far]),
            scene_ids=(scene.id,),
            source_views=(scene.views[source],),
            target_views=(tuple(scene.views[t] for t in targets),),
            target_depth=None if scene.depth is None else scene.depth[index][None],
            target_mask=None if scene.mask is None else scene.mask[index][None],
        )

    @staticmethod
    def collate(samples: Sequence["ViewBatch"]) -> "ViewBatch":
        """Join batches along B.

        Raises:
            ValueError: image sizes, or the numbers of targets, differ.
        """
        joined = {}
        for field in fields(ViewBatch):
            values = [getattr(sample, field.name) for sample in samples]
            if isinstance(values[0], Cameras):
                sizes = {(camera.height, camera.width) for camera in values}
                if len(sizes) > 1:
                    raise ValueError(
                        f"scenes of a batch need images of one size, not {sorted(sizes)}; set data.image_size"
                    )
                c2w, K = (torch.cat([getattr(camera, name) for camera in values]) for name in ("c2w", "K"))
                joined[field.name] = replace(values[0], c2w=c2w, K=K)
            elif isinstance(values[0], Tensor):
                joined[field.name] = torch.cat(values)
            elif values[0] is None:
                joined[field.name] = None
            else:
                joined[field.name] = tuple(item for value in values for item in value)
        return ViewBatch(**joined)

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
        """Move every tensor; by default without waiting where that is safe, which is on the way to CUDA."""
        if non_blocking is None:
            non_blocking = torch.device(device).type == "cuda"
        return self._map(lambda tensor: tensor.to(device, non_blocking=non_blocking))

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
