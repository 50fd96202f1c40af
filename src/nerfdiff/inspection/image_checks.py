"""Checks of images and masks by themselves: do they show something, each something else?"""

from dataclasses import dataclass
from typing import ClassVar

from nerfdiff.data.readers.masks import likely_misreading
from nerfdiff.data.scene import Scene
from nerfdiff.inspection.check import Finding
from nerfdiff.utils.errors import some


@dataclass(frozen=True)
class Images:
    """Images are not of one colour, and none is that of another view with another pose.

    Args:
        contrast: least difference between two pixels of an image that shows something, out of 1.
        max_share: of the views that may be blank or repeat another.
    """

    contrast: float
    max_share: float
    tolerated: float

    measures: ClassVar[str] = "share of the images that are blank or repeat another"
    higher_is_better: ClassVar[bool] = False
    judges_cameras: ClassVar[bool] = False
    matches_images: ClassVar[bool] = False
    tells_focal: ClassVar[bool] = False
    fallback: ClassVar[bool] = False

    def __call__(self, scene: Scene) -> Finding:
        levels = scene.pixels.flatten(2)
        blank = ((levels.amax(2).int() - levels.amin(2).int()).amax(1) < 255 * self.contrast).tolist()
        first: dict[bytes, int] = {}
        repeated = []
        for view, image in enumerate(scene.pixels.numpy()):
            seen = first.setdefault(image.tobytes(), view)
            repeated.append(not blank[view] and not scene.cameras.c2w[view].equal(scene.cameras.c2w[seen]))
        reasons = [
            f"{sum(found)} of {len(found)} images {what}: {some([scene.views[v] for v, f in enumerate(found) if f])}"
            for found, what in ((blank, "are blank"), (repeated, "are those of another view, whose pose is another"))
            if any(found)
        ]
        share = (sum(blank) + sum(repeated)) / len(blank)
        return Finding.judged(share, "; ".join(reasons) if share > self.max_share else None)


@dataclass(frozen=True)
class Masks:
    """Masks are neither empty nor full in every view, and do not cover the border in most, as inverted ones do.

    Args:
        max_border: share of its image's outermost pixels that a mask may cover.
    """

    max_border: float
    tolerated: float

    measures: ClassVar[str] = "share of the pixels that masks hold"
    higher_is_better: ClassVar[bool] = False
    judges_cameras: ClassVar[bool] = False
    matches_images: ClassVar[bool] = False
    tells_focal: ClassVar[bool] = False
    fallback: ClassVar[bool] = False

    def __call__(self, scene: Scene) -> Finding:
        if scene.mask is None:
            return Finding.unchecked("the data have no masks")
        reason = likely_misreading(list(scene.mask.numpy()), self.max_border)
        return Finding.judged(scene.mask.double().mean().item(), reason)
