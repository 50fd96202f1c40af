"""Change an input picture that is out of the training images' range so that it is within: cut-out and sharpness.

Only what lies out of range is changed. Cameras and framing are not: what is told of them may be true. Levels are not:
a light picture may be of a light object.
"""

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
import torch.nn.functional as F
from hydra.utils import instantiate
from jaxtyping import Bool
from omegaconf import DictConfig
from scipy.ndimage import binary_opening
from torch import Tensor

from nerfdiff.data.batch import ViewBatch
from nerfdiff.stability.facts import of_picture
from nerfdiff.stability.familiar import Familiar
from nerfdiff.stress.cutout import grown
from nerfdiff.stress.photo import Picture, object_mask
from nerfdiff.utils.hashes import sha256_values

EDGE = ("edge", "second_edge")
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Mend:
    """Mends inputs, one after another: it removes specks, peels the object's edge, and sharpens.

    Args:
        familiar: of the model's training images, with ranges.
        beyond: widths of its range that a fact must lie beyond before it is mended.
        most_peeled: pixels of the object's edge that may go, where they are too even: a mask that was too large.
        strengths: of an unsharp mask, of which a soft picture gets the one that brings its sharpness nearest to the
            training images' median.
    """

    familiar: Familiar
    beyond: float
    most_peeled: int
    strengths: Sequence[float]

    def __call__(self, scene: ViewBatch) -> ViewBatch:
        """Return a batch of one scene with its input mended; the batch itself where nothing had to be done.

        Sharpening does not bring back what is gone: the picture before it stays as `soft_pixels`, for the judge.
        """
        soft, strength, done = self.picture(scene.source[0].cpu())
        if not done:
            return scene
        log.warning("the input of %s was mended: %s (mend_input=false leaves it)", scene.scene_ids[0], ", ".join(done))

        def pixels(image: Picture) -> torch.Tensor:
            return (image * 255).round().byte()[None].to(scene.source_pixels.device)

        if not strength:
            return replace(scene, source_pixels=pixels(soft))
        return replace(scene, source_pixels=pixels(sharpened(soft, strength)), soft_pixels=pixels(soft))

    @property
    def identity(self) -> list[Any]:
        """What predictions depend on, for a run's identity."""
        ranges = sha256_values(self.familiar.ranges.tolist())
        return [ranges, self.beyond, self.most_peeled, list(self.strengths)]

    def picture(self, image: Picture) -> tuple[Picture, float, list[str]]:
        """Return a picture cut out as the training images are, by how much to sharpen it, and what is done to it."""
        done: list[str] = []
        beyond = self.familiar.picture_beyond
        if not object_mask(image).any() or max(beyond(image).values()) <= self.beyond:
            return image, 0.0, done
        clean = _on_white(image, _without_specks(object_mask(image)))
        if sum(beyond(clean).values()) < sum(beyond(image).values()):
            image = clean
            done.append("specks beside the object were removed")
        peeled, strength = self._edge_and_sharpness(image)
        if peeled:
            image = _on_white(image, grown(object_mask(image), -peeled))
            pixels = "1 pixel of the object's edge was" if peeled == 1 else f"{peeled} pixels of the object's edge were"
            done.append(f"{pixels} removed")
        if strength:
            done.append(f"it was sharpened by {strength:g}")
        return image, strength, done

    def _edge_and_sharpness(self, image: Picture) -> tuple[int, float]:
        """Return how many pixels to peel off, and by how much to sharpen then: the fewest with which both are usual.

        Where none are, nothing is peeled off: a soft picture has an even edge, too.
        """
        mask = object_mask(image)
        for pixels in range(self.most_peeled + 1):
            left = grown(mask, -pixels)
            if not left.any() or (pixels == 1 and self._usual(image, EDGE)):
                break
            peeled = _on_white(image, left)
            strength = self._strength(peeled)
            if self._usual(sharpened(peeled, strength), (*EDGE, "size", "share", "sharpness", "steepness")):
                return pixels, strength
        return 0, self._strength(image)

    def _strength(self, image: Picture) -> float:
        """Of sharpening a soft picture; 0 for others: to soften a noisy one costs more than its noise."""
        usual = self.familiar.usual_value("sharpness")
        if of_picture(image)["sharpness"] > usual or self._usual(image, ("sharpness", "steepness")):
            return 0.0
        return min((0.0, *self.strengths), key=lambda s: abs(of_picture(sharpened(image, s))["sharpness"] - usual))

    def _usual(self, image: Picture, names: Sequence[str]) -> bool:
        beyond = self.familiar.picture_beyond(image)
        return max(beyond.get(name, 0.0) for name in names) <= self.beyond


def mend_of(cfg: DictConfig, familiar: Familiar | None) -> Mend | None:
    """Build `cfg.mend`; None where `mend_input` says no, or the model does not know its training images."""
    if not cfg.mend_input or familiar is None or familiar.ranges is None:
        return None
    return instantiate(cfg.mend)(familiar)


def _without_specks(mask: Bool[Tensor, "height width"]) -> Bool[Tensor, "height width"]:
    """Leave only what an opening by one pixel leaves, with the pixels around it."""
    opened = torch.from_numpy(binary_opening(mask.numpy()))
    return mask & grown(opened, 1) if opened.any() else mask


def _on_white(image: Picture, mask: Bool[Tensor, "height width"]) -> Picture:
    return torch.where(mask, image, torch.ones(()))


def sharpened(image: Picture, strength: float) -> Picture:
    """Add so many times the difference to a picture softened by a binomial filter of 3 × 3: an unsharp mask."""
    row = torch.tensor([0.25, 0.5, 0.25])
    kernel = (row[:, None] * row).expand(3, 1, 3, 3)
    soft = F.conv2d(F.pad(image[None], [1] * 4, mode="replicate"), kernel, groups=3)[0]
    return (image + strength * (image - soft)).clamp(0, 1)
