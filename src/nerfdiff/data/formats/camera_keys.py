"""The keys of a camera in a `transforms.json`, in the spellings of nerfstudio, instant-ngp, COLMAP and OpenCV."""

import math
import re
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from nerfdiff.data.formats.json_files import matrix, optional_number
from nerfdiff.utils.errors import DataError

ALIASES = {
    "fx": ("fl_x",),
    "fy": ("fl_y",),
    "f": ("fl_x", "fl_y"),
    "width": ("w",),
    "image_width": ("w",),
    "height": ("h",),
    "image_height": ("h",),
    "k": ("k1",),
}
"""Other spellings, and what they are called here: COLMAP's `f` is both focal lengths, its `k` is k1."""
DEGREES = {"x_fov": "camera_angle_x", "y_fov": "camera_angle_y"}
"""instant-ngp's fields of view."""
MATRICES = ("K", "camera_matrix", "intrinsics", "intrinsic_matrix")
NERFSTUDIO = ("k1", "k2", "k3", "k4", "p1", "p2")
OPENCV = ("k1", "k2", "p1", "p2", "k3")
LISTS = {
    "distortion_params": NERFSTUDIO,
    "dist_coeffs": OPENCV,
    "distCoeffs": OPENCV,
    "distortion_coefficients": OPENCV,
}
"""Lists of coefficients by their order; what follows must be zero."""
FOCAL = ("fl_x", "fl_y", "camera_angle_x", "camera_angle_y")
MODEL = ("camera_model", "camera_type", "is_fisheye")
READ = (*FOCAL, "cx", "cy", "w", "h", *MODEL, *NERFSTUDIO, "k5", "k6", "mask_path")
"""Keys of a camera that are read, by nerfstudio's names."""
KNOWN = {*READ, *ALIASES, *DEGREES, *MATRICES, *LISTS}
MISSPELT = {name.lower() for name in KNOWN} - {"k", "f"}
"""Refused where they are written with other capitals."""
REFUSED = re.compile(
    r"k\d+|p\d+|s[1-4]|b[12]|tau_?[xy]|ftheta_\w+|(radial_|tangential_|lens_|camera_)?distortion\w*|dist_?coef\w*"
    r"|lat_?long|equirectangular|orthographic|rolling_shutter\w*|skew|(lens_)?shift_[xy]|principal_point\w*"
    r"|intrinsics?\w*|camera_?matrix|(camera_)?params|transform_matrix_(start|end)|normal_mts_args|from_mitsuba"
    r"|black_transparent|(foreground_)?masks?(_\w+)?",
    re.IGNORECASE,
)
"""Keys that change rays or pixels, and are not read."""
REFUSED_ALONE = re.compile(r"focal\w*|fl|\w*fov\w*|camera_angle\w*", re.IGNORECASE)
"""Keys refused where no focal length stands beside them: which unit they have is not known."""
ALMOST_EQUAL = 1e-3
"""Largest relative difference between two spellings of one number that rounding explains."""


def camera_keys(values: Mapping[str, Any], where: str) -> dict[str, Any]:
    """The keys of `READ` that a frame, or a file beside its frames, states in whichever spelling.

    What is null counts as not stated. Keys that change neither rays nor pixels are left out.

    Raises:
        DataError: two spellings contradict each other, a list or matrix has another form, or a key that would change
            rays or pixels is not read and is not without effect (zero, false, empty).
    """
    stated = {key: value for key, value in values.items() if value is not None}
    found = {key: stated[key] for key in READ if key in stated}
    sources = dict(zip(found, found, strict=True))
    for key, value in stated.items():
        for name, number in _spelled(key, value, where).items():
            if name in found and not _same(found[name], number):
                raise DataError(
                    f"{where}: {sources[name]!r} gives {name} = {repr(found[name])[:40]}, but {key!r} gives "
                    f"{repr(number)[:40]}; keep the one that is right"
                )
            found[name], sources[name] = found.get(name, number), sources.get(name, key)
    focal = not found.keys().isdisjoint(FOCAL)
    for key, value in stated.items():
        if key in KNOWN or _without_effect(value):
            continue
        nested = key in ("camera", "cameras") and isinstance(value, Mapping | list)
        if nested or REFUSED.fullmatch(key) or key.lower() in MISSPELT or (REFUSED_ALONE.fullmatch(key) and not focal):
            raise DataError(
                f"{where}: the key {key[:80]!r} would change rays or pixels, and is not read; expected a camera as "
                f"{', '.join(READ)}. Write it so, undistort the images, or take the key out if it has no effect"
            )
    return found


def frame_camera(shared: Mapping[str, Any], own: Mapping[str, Any]) -> dict[str, Any]:
    """A frame's camera: its own keys before those of the file.

    A frame's focal length or field of view takes the place of all of the file's.
    """
    if "fl_x" in own or "camera_angle_x" in own:
        shared = {key: value for key, value in shared.items() if key not in FOCAL}
    return {**shared, **own}


def _spelled(key: str, value: Any, where: str) -> dict[str, Any]:
    """Translate another spelling of a key to the names of `READ`."""
    if key in ALIASES:
        return dict.fromkeys(ALIASES[key], value)
    if key in DEGREES:
        return {DEGREES[key]: math.radians(optional_number({key: value}, key, where))}
    if key not in LISTS and key not in MATRICES:
        return {}
    if isinstance(value, Mapping) and "data" in value:  # as OpenCV writes a matrix
        value = value["data"]
    if key in MATRICES:
        return _intrinsics(matrix(value, 3, 3, f"{where}: {key!r}"), f"{where}: {key!r}")
    names, numbers = LISTS[key], _numbers(value, f"{where}: {key!r}")
    if len(numbers) < 4 or any(numbers[len(names) :]) or (names is NERFSTUDIO and len(numbers) != len(names)):
        if not any(numbers):
            return {}
        raise DataError(
            f"{where}: expected {key!r} as [{', '.join(names)}], found {numbers}; others are not read: undistort the "
            "images"
        )
    return dict(zip(names, numbers, strict=False))


def _numbers(value: Any, where: str) -> list[float]:
    try:
        numbers = np.asarray(value, dtype=np.float64).ravel()
    except (TypeError, ValueError, OverflowError):
        numbers = np.array([math.nan])
    if not np.isfinite(numbers).all():
        raise DataError(f"{where}: expected a list of finite numbers, found {repr(value)[:80]}")
    return numbers.tolist()


def _intrinsics(K: Float[np.ndarray, "3 3"], where: str) -> dict[str, float]:
    if K[0, 1] or K[1, 0] or K[2].tolist() != [0, 0, 1] or not np.isfinite(K).all():
        raise DataError(f"{where}: expected [[fl_x, 0, cx], [0, fl_y, cy], [0, 0, 1]], found {K.tolist()}")
    return {"fl_x": float(K[0, 0]), "fl_y": float(K[1, 1]), "cx": float(K[0, 2]), "cy": float(K[1, 2])}


def _same(one: Any, other: Any) -> bool:
    if isinstance(one, int | float) and isinstance(other, int | float) and max(abs(one), abs(other)) < 1e300:
        return math.isclose(one, other, rel_tol=ALMOST_EQUAL, abs_tol=1e-9)
    return bool(one == other)


def _without_effect(value: Any) -> bool:
    if isinstance(value, list):
        return all(map(_without_effect, value))
    return not value
