"""Faults in the training set: some of its scenes have wrong poses, swapped images or white images."""

from collections.abc import Sequence
from dataclasses import replace

import torch

from nerfdiff.cameras import Cameras
from nerfdiff.data.scene import Listing, Scene, SceneReader
from nerfdiff.utils.randomness import generator


def wrong_poses(scene: Scene, draws: torch.Generator) -> Scene:
    """Give each image the pose of another image of the scene, as a file in another order does."""
    order = _derangement(len(scene.views), draws)
    cameras = Cameras(scene.cameras.c2w[order], scene.cameras.K, scene.cameras.height, scene.cameras.width)
    return replace(scene, cameras=cameras)


def white_images(scene: Scene, draws: torch.Generator) -> Scene:
    """Make all images white."""
    return replace(scene, pixels=torch.full_like(scene.pixels, 255))


def _derangement(count: int, draws: torch.Generator) -> torch.Tensor:
    """A turn by at least one of a random order: nothing stays in its place."""
    order = torch.randperm(count, generator=draws)
    moved = torch.empty_like(order)
    moved[order] = order.roll(1)
    return moved


class FaultyReader:
    """Read a split in which a share of the scenes is faulty.

    Args:
        reader: of the sound files.
        share: of the scenes, chosen by `seed`; at least one.
        fault: `wrong_poses`, `white_images`, or None: the images are those of another scene.
        seed: of the choice and of the faults.
    """

    def __init__(self, reader: SceneReader, share: float, fault, seed: int):
        self.reader, self.fault, self.seed = reader, fault, seed
        count = max(1, round(share * len(reader)))
        order = torch.randperm(len(reader), generator=generator("cpu", seed, "faulty scenes")).tolist()
        self.faulty = set(order[:count])
        name = fault.__name__ if fault else "swapped images"
        self.identity = f"{reader.identity}, {name} in {count} of {len(reader)} scenes by seed {seed}"
        self.nearest_view = reader.nearest_view

    def __len__(self) -> int:
        return len(self.reader)

    def fingerprint(self) -> str:
        return self.reader.fingerprint()

    def scene_id(self, index: int) -> str:
        return self.reader.scene_id(index)

    def view_names(self, index: int) -> tuple[str, ...]:
        return self.reader.view_names(index)

    def listing(self, index: int) -> Listing:
        return self.reader.listing(index)

    def load(self, index: int, views: Sequence[int] | None = None, truth: bool = False) -> Scene:
        if index not in self.faulty:
            return self.reader.load(index, views, truth)
        whole = self.reader.load(index, None, truth)
        draws = generator("cpu", self.seed, "fault", index)
        if self.fault is None:
            other = self.reader.load((index + 1) % len(self.reader))
            chosen = torch.arange(len(whole.views)) % len(other.views)
            whole = replace(whole, pixels=other.pixels[chosen])
        else:
            whole = self.fault(whole, draws)
        return whole if views is None else _chosen(whole, list(views))


def _chosen(scene: Scene, views: list[int]) -> Scene:
    def of(values):
        return None if values is None else values[views]

    return replace(
        scene,
        views=tuple(scene.views[view] for view in views),
        pixels=scene.pixels[views],
        cameras=scene.cameras[views],
        mask=of(scene.mask),
        depth=of(scene.depth),
    )
