"""Distortion taken out of images, against a projection that distorts and shares no code with nerfdiff."""

import json
import math

import numpy as np
import pytest
import torch
from PIL import Image

from nerfdiff.data.formats.lens import Lens
from nerfdiff.data.readers.posed_images import PosedImagesReader
from nerfdiff.utils.errors import DataError
from posed_fixtures import CENTRE, COLOURS, CX, CY, FX, FY, HEIGHT, POINTS, SETTINGS, WIDTH, project, write_nerfstudio

BARREL = {"k1": -0.22, "k2": 0.05, "p1": 0.006, "p2": -0.009}
CUSHION = {"k1": 0.15, "k2": 0.04, "k3": 0.02, "k4": 0.03, "p1": -0.004}
SCALE = 4
WIDE = CENTRE + 1.7 * (POINTS - CENTRE)  # as far from the middle of the images as they allow


def distorted(u: float, v: float, intrinsics, lens: dict) -> tuple[float, float]:
    """Where a lens shows what a pinhole has at (u, v), by the formula in nerfstudio's documentation."""
    fx, fy, cx, cy = intrinsics
    k1, k2, k3, k4, p1, p2 = (lens.get(key, 0.0) for key in ("k1", "k2", "k3", "k4", "p1", "p2"))
    x, y = (u - cx) / fx, (v - cy) / fy
    r2 = x**2 + y**2
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3 + k4 * r2**4
    xd = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2)
    yd = y * radial + 2 * p2 * x * y + p1 * (r2 + 2 * y**2)
    return fx * xd + cx, fy * yd + cy


def matrix(fx, fy, cx, cy) -> np.ndarray:
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])


def write_distorted(folder, lens: dict, per_frame: bool) -> np.ndarray:
    """A capture whose squares lie where the lens shows the known points; returns its poses."""
    poses = write_nerfstudio(folder, scales=(SCALE,))
    file = folder / "transforms.json"
    content = json.loads(file.read_text())
    intrinsics = [SCALE * x for x in (FX, FY, CX, CY)]
    for frame, pose in zip(content["frames"], poses, strict=True):
        image, mask = np.full((SCALE * HEIGHT, SCALE * WIDTH, 3), 90, np.uint8), np.zeros((160, 224), np.uint8)
        for (u, v, _), colour in zip(project(pose, WIDE, intrinsics), COLOURS, strict=True):
            column, row = map(math.floor, distorted(u, v, intrinsics, lens))
            where = slice(max(row - 3, 0), row + 4), slice(max(column - 3, 0), column + 4)
            image[where], mask[where] = colour, 255
        Image.fromarray(image).save(folder / frame["file_path"])
        Image.fromarray(mask).save(folder / frame["mask_path"])
        frame |= {**dict(zip(("fl_x", "fl_y", "cx", "cy"), intrinsics, strict=True)), "w": 224, "h": 160}
        if per_frame:
            frame |= lens
    if not per_frame:
        content |= lens
    file.write_text(json.dumps(content))
    return poses


@pytest.mark.parametrize("per_frame", [False, True])
@pytest.mark.parametrize("lens", [BARREL, CUSHION], ids=["barrel", "cushion"])
def test_points_are_where_the_pinhole_has_them(tmp_path, lens, per_frame):
    poses = write_distorted(tmp_path, lens, per_frame)
    scene = PosedImagesReader(tmp_path, "train", **SETTINGS).load(0, truth=True)
    assert scene.pixels.shape == (6, 3, 160, 224) and scene.mask.shape == (6, 160, 224)
    intrinsics = [SCALE * x for x in (FX, FY, CX, CY)]
    np.testing.assert_array_equal(scene.cameras.K, np.stack([matrix(*intrinsics)] * 6))
    pixels, _ = scene.cameras.project(torch.from_numpy(WIDE).float())
    checked, moved = 0, 0.0
    for view, pose in enumerate(poses):
        expected = project(pose, WIDE, intrinsics)[:, :2]
        np.testing.assert_allclose(pixels[view], expected, atol=5e-3)
        for k, (u, v) in enumerate(expected):
            apart = np.delete(np.abs(expected - [u, v]).max(1), k).min()
            if not (8 < u < 216 and 8 < v < 152 and apart > 16):
                continue
            column, row = math.floor(u), math.floor(v)
            assert np.abs(scene.pixels[view, :, row, column].int().numpy() - COLOURS[k]).max() <= 1
            assert scene.mask[view, row, column]
            shown = np.array(distorted(u, v, intrinsics, lens))
            square = scene.mask[view, row - 8 : row + 9, column - 8 : column + 9].nonzero().double().mean(0).numpy()
            off = square[::-1] - 7.5 + (column, row) - (u, v)
            assert np.abs(off - (np.floor(shown) + 0.5 - shown)).max() < 0.6  # squares were drawn in whole pixels
            moved = max(moved, math.dist(shown, (u, v)))
            checked += 1
    assert checked > 12 and moved > 2
    outside = ~scene.mask[:, None].expand_as(scene.pixels)
    assert (scene.pixels[outside] == 255).all()


@pytest.mark.parametrize("per_frame", [False, True])
def test_lists_of_coefficients_are_the_same_lens(tmp_path, per_frame):
    """nerfstudio's list, and OpenCV's with the same numbers in its own order."""
    write_distorted(tmp_path, BARREL, per_frame)
    file = tmp_path / "transforms.json"
    content = json.loads(file.read_text())
    k1, k2, p1, p2 = BARREL.values()
    reads = [PosedImagesReader(tmp_path, "train", **SETTINGS).load(0, [1, 3]).pixels]
    for lists in ({"distortion_params": [k1, k2, 0, 0, p1, p2]}, {"dist_coeffs": [k1, k2, p1, p2, 0]}, {}):
        for place in (content, *content["frames"]):
            for key in (*BARREL, "distortion_params"):
                place.pop(key, None)
        for place in content["frames"] if per_frame else [content]:
            place |= lists
        file.write_text(json.dumps(content))
        reads.append(PosedImagesReader(tmp_path, "train", **SETTINGS).load(0, [1, 3]).pixels)
        content = {key: value for key, value in content.items() if key != "dist_coeffs"}
        for frame in content["frames"]:
            frame.pop("dist_coeffs", None)
    assert torch.equal(reads[0], reads[1]) and torch.equal(reads[0], reads[2])
    assert (reads[0] != reads[3]).any()


@pytest.mark.parametrize("lens", [BARREL, CUSHION], ids=["barrel", "cushion"])
def test_ramps_are_read_where_the_lens_shows_them(lens):
    """Bilinear sampling of a ramp is exact: this is a test of the map to a twentieth of a pixel, borders included."""
    height, width, slope = 20, 24, 10
    intrinsics = (13.0, 14.0, 11.2, 10.7)
    rows, columns = np.indices((height, width))
    ramps = np.stack([columns * slope, rows * slope, 0 * rows], -1).astype(np.uint8)
    found = Lens("frame", tuple(lens.get(f"k{n}", 0) for n in range(1, 5)), (lens["p1"], lens.get("p2", 0))).image(
        ramps, matrix(*intrinsics)
    )
    expected = np.empty((height, width, 2))
    for row in range(height):
        for column in range(width):
            u, v = distorted(column + 0.5, row + 0.5, intrinsics, lens)
            expected[row, column] = min(max(u - 0.5, 0), width - 1), min(max(v - 0.5, 0), height - 1)
    assert np.abs(found[..., :2] - slope * expected).max() < 0.51 + 1e-3 * slope
    assert np.abs(found[..., :2].astype(int) - ramps[..., :2]).max() > 5 * slope / 4


def test_masks_end_where_the_stored_image_does():
    height, width, intrinsics = 20, 24, (13.0, 14.0, 11.2, 10.7)
    lens = Lens("frame", (0.15, 0.0, 0.0, 0.0), (0.0, 0.0))
    found = lens.mask(np.ones((height, width), bool), matrix(*intrinsics))
    for row in range(height):
        for column in range(width):
            u, v = distorted(column + 0.5, row + 0.5, intrinsics, {"k1": 0.15})
            assert found[row, column] == (0 <= u <= width and 0 <= v <= height)
    assert found.any() and not found.all()


def test_what_lies_past_the_fold_is_not_shown_twice():
    """With k1 = −0.3 the distorted radius grows up to r = 1 / √0.9 and then comes back."""
    height, width, intrinsics = 60, 60, (25.0, 25.0, 30.0, 30.0)
    image = np.full((height, width, 3), 200, np.uint8)
    image[20:40, 20:40] = 0
    lens = Lens("frame", (-0.3, 0.0, 0.0, 0.0), (0.0, 0.0))
    mask = lens.mask(np.ones((height, width), bool), matrix(*intrinsics))
    v, u = np.indices((height, width)) + 0.5
    r = np.hypot(u - 30, v - 30) / 25
    fold = 1 / math.sqrt(0.9)
    assert mask[r < fold - 0.01].all() and not mask[r > fold].any() and (r > fold).sum() > 100
    assert (lens.image(image, matrix(*intrinsics))[r > fold] == 200).all()


@pytest.mark.parametrize("keys", [(), ("k1", "k2", "p1", "p2"), ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")])
def test_no_distortion_leaves_pixels_as_they_are(tmp_path, keys):
    write_nerfstudio(tmp_path, masks=False)
    content = json.loads((tmp_path / "transforms.json").read_text())
    for key in ("k1", "k2", "p1", "p2"):
        del content[key]
    (tmp_path / "transforms.json").write_text(json.dumps(content | dict.fromkeys(keys, 0.0)))
    noise = np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)
    Image.fromarray(noise).save(tmp_path / "images/frame_00001.png")
    scene = PosedImagesReader(tmp_path, "train", **SETTINGS).load(0, [0])
    assert np.array_equal(scene.pixels[0].permute(1, 2, 0), noise)


def test_transparency_is_undistorted_with_the_image(tmp_path):
    """A vertical edge at 50 of 56 pixels, of an image whose other side is transparent."""
    write_nerfstudio(tmp_path, masks=False, k1=0.6)
    rgba = np.full((HEIGHT, WIDTH, 4), 60, np.uint8)
    rgba[..., 3] = np.where(np.arange(WIDTH) < 50, 255, 0)
    for file in (tmp_path / "images").iterdir():
        Image.fromarray(rgba).save(file)
    scene = PosedImagesReader(tmp_path, "train", **SETTINGS).load(0, [0], truth=True)
    row = int(CY)
    edge = next(c for c in range(WIDTH) if distorted(c + 0.5, row + 0.5, (FX, FY, CX, CY), {"k1": 0.6})[0] > 50)
    assert edge < 49
    assert scene.mask[0, row, 5:edge].all() and not scene.mask[0, row, edge:].any()  # what is left of 5 is not shown
    assert (scene.pixels[0, :, row, : edge - 1] == 60).all() and (scene.pixels[0, :, row, edge + 1 :] == 255).all()


def test_coefficients_of_no_lens_are_refused(tmp_path):
    write_nerfstudio(tmp_path, k1=-40.0)
    reader = PosedImagesReader(tmp_path, "train", **SETTINGS)
    with pytest.raises(
        DataError, match=r"frames\[0\] \(images/frame_00001\.png\).*no lens has such coefficients"
    ) as error:
        reader.load(0)
    assert "\n" not in str(error.value)
