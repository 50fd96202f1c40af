"""Depth in OpenEXR files.

Mitsuba reads them too, but not in a loader's worker that was forked from a process which has read one: that hangs.
"""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from nerfdiff.utils.errors import DataError

DEPTH_CHANNELS = ("Z", "V", "R", "Y")
"""Names under which renderers store one value; Blender's file output names it V, or repeats it in R, G and B."""


def read_exr(path: Path, size: tuple[int, int]) -> Float[np.ndarray, "height width"]:
    """The depth channel of an EXR image, as float32 (half floats and all of EXR's compressions included).

    Args:
        size: (height, width) that the image has to have.

    Raises:
        DataError: the file is missing, truncated, no EXR image, or of another size; or OpenEXR is not installed.
    """
    if not path.is_file():
        raise DataError(f"{path}: no such EXR image")
    try:
        import OpenEXR  # only ground truth needs it
    except ImportError as error:
        raise DataError(f"{path}: reading it takes the package OpenEXR ({error}); pip install openexr") from error
    try:
        with OpenEXR.File(str(path), header_only=True) as file:
            window = file.header()["dataWindow"]
        found = tuple(int(length) for length in (window[1] - window[0] + 1)[::-1])
        if found != size:  # before a damaged header has that much memory allocated
            raise DataError(f"{path}: {found[0]}x{found[1]} values, but the image has {size[0]}x{size[1]}")
        with OpenEXR.File(str(path), separate_channels=True) as file:
            channels = {name: channel.pixels for name, channel in file.channels().items()}
        name = next((name for name in DEPTH_CHANNELS if name in channels), None) or min(channels)
        values = np.asarray(channels[name], dtype=np.float32)
    except DataError:
        raise
    except Exception as error:  # its bindings raise a different one for every kind of damage
        reason = " ".join(str(error).replace(str(path), "it").split())
        raise DataError(f"{path}: not a whole EXR image ({reason}); copy it anew") from error
    if values.shape != size:
        raise DataError(f"{path}: channel {name} has shape {values.shape}, but the image has {size[0]}x{size[1]}")
    return values
