"""Spellings of a camera's keys: read, refused by name, or without effect; beside the frames and in them."""

import json
import math

import pytest

from nerfdiff.data.formats.transforms_json import read_transforms
from nerfdiff.utils.errors import DataError
from posed_fixtures import CX, CY, FX, FY, HEIGHT, WIDTH, write_nerfstudio

SHARED = ("fl_x", "fl_y", "cx", "cy", "w", "h", "k1", "k2", "p1", "p2", "camera_model")


def write(folder, keys: dict, place: str, without=SHARED, **top) -> None:
    """A capture that has `keys` beside the frames, or in the second one, and lacks `without` there."""
    write_nerfstudio(folder, views=3, masks=False)
    content = json.loads((folder / "transforms.json").read_text())
    before = {key: content[key] for key in SHARED}
    target = content if place == "file" else content["frames"][1]
    for key in without:
        content.pop(key, None)
    if place == "frame":
        for frame in content["frames"]:
            frame |= {key: before[key] for key in without}
        for key in without:
            del target[key]
    target |= keys
    (folder / "transforms.json").write_text(json.dumps(content | top))


def camera(folder) -> tuple[list[float], tuple, tuple]:
    """(fl_x, fl_y, cx, cy), radial and tangential coefficients of the second frame."""
    frame = read_transforms(folder).frames[1]
    K = frame.pinhole.K(HEIGHT, WIDTH)
    lens = ((0, 0, 0, 0), (0, 0)) if frame.lens is None else (frame.lens.radial, frame.lens.tangential)
    return [K[0, 0], K[1, 1], K[0, 2], K[1, 2]], *lens


NORMAL = {"fl_x": FX, "fl_y": FY, "cx": CX, "cy": CY, "w": WIDTH, "h": HEIGHT}
MATRIX = [[FX, 0, CX], [0, FY, CY], [0, 0, 1]]
ROW = [number for row in MATRIX for number in row]
SPELLINGS = {
    "COLMAP pinhole": ({"fx": FX, "fy": FY, "cx": CX, "cy": CY, "width": WIDTH, "height": HEIGHT}, FY, (0, 0, 0, 0), 0),
    "COLMAP simple radial": (
        {"camera_model": "SIMPLE_RADIAL", "f": FX, "cx": CX, "cy": CY, "k": -0.1},
        FX,
        (-0.1, 0, 0, 0),
        0,
    ),
    "matrix": ({"K": MATRIX}, FY, (0, 0, 0, 0), 0),
    "matrix in a row": ({"intrinsics": ROW}, FY, (0, 0, 0, 0), 0),
    "OpenCV": (
        {
            "camera_matrix": {"rows": 3, "cols": 3, "data": ROW},
            "distortion_coefficients": {"rows": 1, "cols": 5, "data": [0.1, 0.02, 0.3, 0.4, 0.05]},
        },
        FY,
        (0.1, 0.02, 0.05, 0),
        (0.3, 0.4),
    ),
    "OpenCV of 4": ({**NORMAL, "dist_coeffs": [0.1, 0.02, 0.3, 0.4]}, FY, (0.1, 0.02, 0, 0), (0.3, 0.4)),
    "OpenCV nested, no denominator": (
        {**NORMAL, "distCoeffs": [[0.1, 0.02, 0.3, 0.4, 0.05, 0, 0, 0]]},
        FY,
        (0.1, 0.02, 0.05, 0),
        (0.3, 0.4),
    ),
    "nerfstudio's list": (
        {**NORMAL, "distortion_params": [0.1, 0.2, 0.3, 0.4, 0.5, 0.6]},
        FY,
        (0.1, 0.2, 0.3, 0.4),
        (0.5, 0.6),
    ),
    "nerfstudio's list of an ideal lens": ({**NORMAL, "distortion_params": [0.0] * 4}, FY, (0, 0, 0, 0), 0),
    "both, alike": (
        {**NORMAL, "fx": FX, "K": MATRIX, "k1": 0.1, "distortion_params": [0.1, 0, 0, 0, 0, 0]},
        FY,
        (0.1, 0, 0, 0),
        0,
    ),
    "a model in small letters": ({**NORMAL, "camera_model": "opencv", "camera_type": "perspective"}, FY, (0,) * 4, 0),
    "instant-ngp's degrees": (
        {"x_fov": math.degrees(2 * math.atan(28 / FX)), "y_fov": math.degrees(2 * math.atan(20 / FY)), "cx": CX}
        | {"cy": CY, "w": WIDTH, "h": HEIGHT},
        FY,
        (0, 0, 0, 0),
        0,
    ),
    "null": ({**NORMAL, "fx": None, "K": None, "distortion_params": None, "k3": None}, FY, (0, 0, 0, 0), 0),
}


@pytest.mark.parametrize("place", ["file", "frame"])
@pytest.mark.parametrize("name", SPELLINGS)
def test_known_spellings_are_read(tmp_path, name, place):
    keys, fy, radial, tangential = SPELLINGS[name]
    write(tmp_path, keys, place)
    found, found_radial, found_tangential = camera(tmp_path)
    assert found == pytest.approx([FX, fy, CX, CY])
    assert (found_radial, found_tangential) == (radial, tangential or (0, 0))


REFUSED = {
    "k7": 0.1,
    "k": [1, 2],
    "p3": 0.1,
    "s1": 0.01,
    "b2": 1.5,
    "K1": -0.3,
    "Camera_Model": "FISHEYE",
    "distortion": [0.1, 0.2],
    "radial_distortion": [0.1],
    "distortion_params": [0.1, 0, 0, 0],
    "dist_coeffs": [0.1, 0, 0, 0, 0, 0.2, 0, 0],
    "distortion_coefficients": "lens.yaml",
    "distortion_model": "equidistant",
    "ftheta_p1": 0.001,
    "equirectangular": True,
    "latlong": True,
    "rolling_shutter": [0, 0, 0.1, 0],
    "skew": 0.5,
    "shift_x": 0.1,
    "principal_point": [0.5, 0.5],
    "K": [[60, 1, 26], [0, 55, 21.5], [0, 0, 1]],
    "intrinsics": {"fx": 60},
    "camera": {"angle_x": 0.7},
    "params": [60, 26, 21.5, 0.1],
    "camera_type": "fisheye",
    "transform_matrix_end": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]],
    "from_mitsuba": True,
    "black_transparent": True,
    "mask": "masks/1.png",
    "mask_file_path": "masks/1.png",
    "fx": 2 * FX,
    "width": 2 * WIDTH,
}


@pytest.mark.parametrize("place", ["file", "frame"])
@pytest.mark.parametrize("key", REFUSED)
def test_keys_that_matter_are_refused_by_name(tmp_path, key, place):
    without = () if key in ("fx", "width", "K") else SHARED[6:]
    write(tmp_path, {key: REFUSED[key]} | (NORMAL if key in ("fx", "width", "K") else {}), place, without)
    with pytest.raises(DataError) as error:
        read_transforms(tmp_path)
    message = str(error.value)
    assert repr(key) in message or repr(REFUSED[key]) in message
    assert f"{tmp_path}/transforms.json" in message and "\n" not in message
    assert ("frames[1] (images/frame_00002.png)" in message) or place == "file"


def test_an_unknown_focal_length_is_refused_only_where_it_is_the_only_one(tmp_path):
    write(tmp_path / "a", {"focal_length": 35.0, "FovX": 0.8}, "file", ())
    assert camera(tmp_path / "a")[0] == [FX, FY, CX, CY]
    write(tmp_path / "b", {"focal_length": 35.0}, "frame", ())
    with pytest.raises(DataError, match=r"frames\[1\].*'focal_length' would change rays"):
        read_transforms(tmp_path / "b")


@pytest.mark.parametrize("place", ["file", "frame"])
def test_keys_without_effect_are_ignored(tmp_path, place):
    nothing = {"k7": 0.0, "distortion": [], "rolling_shutter": [0, 0, 0, 0], "equirectangular": False, "skew": None}
    other = {"aabb_scale": 16, "scale": 0.33, "offset": [0, 0, 1], "applied_scale": 2.0, "sharpness": 41.2, "note": "x"}
    more = {"ply_file_path": "a.ply", "depth_file_path": "d.png", "colmap_im_id": 3, "rotation": 0.01, "camera": "left"}
    write(tmp_path, nothing | other | more, place, ())
    assert camera(tmp_path) == ([FX, FY, CX, CY], (0, 0, 0, 0), (0, 0))


@pytest.mark.parametrize(
    ("own", "expected"),
    [
        ({"camera_angle_x": 1.0}, [28 / math.tan(0.5)] * 2),
        ({"x_fov": math.degrees(1.0)}, [28 / math.tan(0.5)] * 2),
        ({"fl_x": 70.0}, [70, 70]),
        ({"fy": 70.0}, [FX, 70]),
    ],
)
def test_a_frames_focal_length_or_angle_takes_the_place_of_the_files(tmp_path, own, expected):
    write(tmp_path, own, "frame", (), camera_angle_y=0.3)
    assert camera(tmp_path)[0] == pytest.approx([*expected, CX, CY])
    assert read_transforms(tmp_path).frames[0].pinhole.K(HEIGHT, WIDTH)[0, 0] == FX


@pytest.mark.parametrize(
    ("shared", "own", "radial"),
    [
        ({"k1": 0.1, "k2": 0.2}, {"distortion_params": [-0.3, 0, 0, 0, 0, 0]}, (-0.3, 0, 0, 0)),
        ({"distortion_params": [0.1, 0.2, 0.3, 0, 0, 0]}, {"k1": -0.2}, (-0.2, 0.2, 0.3, 0)),
        ({"k1": 0.1, "k2": 0.0}, {"k1": None}, (0.1, 0, 0, 0)),
    ],
)
def test_a_frames_lens_comes_before_the_files_in_any_spelling(tmp_path, shared, own, radial):
    write(tmp_path, own, "frame", ())
    content = json.loads((tmp_path / "transforms.json").read_text())
    for key in ("k1", "k2"):
        del content[key]
    (tmp_path / "transforms.json").write_text(json.dumps(content | shared))
    assert camera(tmp_path)[1] == radial


def test_spellings_that_contradict_each_other_are_both_named(tmp_path):
    write(tmp_path, {"k1": 0.1, "distortion_params": [0.2, 0, 0, 0, 0, 0]}, "frame")
    with pytest.raises(DataError, match=r"frames\[1\].*'k1' gives k1 = 0\.1, but 'distortion_params' gives 0\.2"):
        read_transforms(tmp_path)


def test_one_mask_may_be_that_of_all_frames(tmp_path):
    write(tmp_path, {"mask_path": "rig.png"}, "file", ())
    assert [frame.mask for frame in read_transforms(tmp_path).frames] == [tmp_path / "rig.png"] * 3
