"""All views of a scene, also those that are not read: are their files there, and do their cameras stand together?"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from nerfdiff.data.readers.bounds import Gaze
from nerfdiff.data.scene import Listing
from nerfdiff.inspection.check import Finding
from nerfdiff.utils.errors import DataError, some


def refuse_missing_files(listing: Listing) -> None:
    """Before a training or an evaluation finds out.

    Raises:
        DataError: some files of the scene's views are not there.
    """
    missing = [view for view, files in listing.files.items() if not all(file.exists() for file in files)]
    if missing:
        first = next(file for file in listing.files[missing[0]] if not file.exists())
        raise DataError(
            f"{first}: no such file; {len(missing)} of {len(listing.files)} views lack files: {some(missing)}"
        )


@dataclass(frozen=True)
class StrayCameras:
    """No camera stands at a quite different distance from what all look at than the others (`bounds.Gaze.stray`)."""

    tolerated: float

    measures: ClassVar[str] = "distance of a camera from what all look at, over the middle one, or its inverse"
    higher_is_better: ClassVar[bool] = False

    def __call__(self, listing: Listing) -> Finding:
        gaze = Gaze.of(listing.c2w)
        if gaze.parallel:
            return Finding.unchecked("the optical axes are near-parallel")
        ratios = np.maximum(gaze.distances, 1e-12) / max(np.median(gaze.distances), 1e-12)
        return Finding.judged(float(np.maximum(ratios, 1 / ratios).max()), gaze.describe_strays(list(listing.files)))
