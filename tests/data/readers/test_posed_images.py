"""A person's own scenes: pixels, splits, masks, mixed sizes, bounds, and what is wrong with them."""

import json
import logging
import math
import os
import pickle
import shutil

import numpy as np
import pytest
import torch
from hydra.utils import instantiate
from PIL import Image

from nerfdiff.cli import load_config
from nerfdiff.data.cache import CachedReader
from nerfdiff.data.readers import posed_images
from nerfdiff.data.readers.posed_images import PosedImagesReader
from nerfdiff.data.scene import MissingSplit, SceneReader
from nerfdiff.utils.errors import ConfigError, DataError
from posed_fixtures import (
    COLOURS,
    CX,
    CY,
    FX,
    FY,
    HEIGHT,
    POINTS,
    SETTINGS,
    WIDTH,
    project,
    write_blender,
    write_nerfstudio,
)


def read(root, split="train", **changes) -> PosedImagesReader:
    return PosedImagesReader(root, split, **{**SETTINGS, **changes})


def edit(file, change) -> None:
    content = json.loads(file.read_text())
    change(content)
    file.write_text(json.dumps(content))


def assert_colours_found(scene, tolerance: int) -> None:
    """The known colours lie where the scene's own cameras project the known points."""
    pixels, _ = scene.cameras.project(torch.from_numpy(POINTS).float())
    checked = 0
    for view in range(len(scene.views)):
        for k in range(len(POINTS)):
            u, v = pixels[view, k]
            inside = 1 < u < scene.cameras.width - 1 and 1 < v < scene.cameras.height - 1
            others = (pixels[view] - pixels[view, k]).abs().amax(-1)
            clear = torch.cat([others[:k], others[k + 1 :]]).min() > 6
            if inside and clear:
                difference = scene.pixels[view, :, int(v), int(u)].int() - torch.from_numpy(COLOURS[k]).int()
                assert difference.abs().max() <= tolerance
                checked += 1
    assert checked >= 2 * len(scene.views)


def test_nerfstudio_points_lie_on_their_pixels(tmp_path):
    poses = write_nerfstudio(tmp_path)
    reader = read(tmp_path)
    assert isinstance(reader, SceneReader) and len(reader) == 1 and reader.scene_id(0) == tmp_path.name
    scene = reader.load(0)
    assert scene.views == reader.view_names(0) == tuple(f"frame_{k + 1:05d}" for k in range(6))
    pixels, depth = scene.cameras.project(torch.from_numpy(POINTS).float())
    expected = np.stack([project(pose) for pose in poses])
    np.testing.assert_allclose(pixels, expected[..., :2], atol=1e-3)
    np.testing.assert_allclose(depth, expected[..., 2], atol=1e-4)
    assert scene.pixels.shape == (6, 3, HEIGHT, WIDTH) and scene.mask is None and scene.depth is None
    assert_colours_found(scene, 0)


def test_blender_points_lie_on_their_pixels(tmp_path):
    poses = write_blender(tmp_path / "lego")
    scene = read(tmp_path).load(0, truth=True)
    assert scene.id == "lego" and scene.views == tuple(sorted(poses))
    pixels, _ = scene.cameras.project(torch.from_numpy(POINTS).float())
    expected = np.stack(
        [project(poses[view], intrinsics=(FX, FX, WIDTH / 2, HEIGHT / 2))[:, :2] for view in scene.views]
    )
    np.testing.assert_allclose(pixels, expected, atol=1e-3)
    assert_colours_found(scene, 0)
    background = ~scene.mask[:, None].expand_as(scene.pixels)
    assert (scene.pixels[background] == 255).all() and 0.01 < scene.mask.float().mean() < 0.5


def test_rays_through_pixels_come_back_to_them(tmp_path):
    poses = write_nerfstudio(tmp_path)
    rays = read(tmp_path).load(0).cameras.rays(1, 5)
    for row, column in ((0, 0), (7, 50), (39, 3)):
        points = (rays.origins + 2.5 * rays.directions)[:, row, column].double().numpy()
        for pose, point in zip(poses, points, strict=True):
            np.testing.assert_allclose(project(pose, point[None])[0, :2], [column + 0.5, row + 0.5], atol=1e-3)


def test_sizes_that_differ_come_to_one_with_their_own_intrinsics(tmp_path):
    poses = write_nerfstudio(tmp_path, scales=(1, 2, 3))
    with pytest.raises(DataError, match=r"frame_00002\.png: 80x112 pixels, other views .* 40x56; set data\.image_size"):
        read(tmp_path).load(0)
    scene = read(tmp_path, image_size=[80, 112]).load(0)
    assert scene.pixels.shape == (6, 3, 80, 112)
    assert torch.equal(
        scene.cameras.K, torch.tensor([[2 * FX, 0, 2 * CX], [0, 2 * FY, 2 * CY], [0, 0, 1]]).expand(6, 3, 3)
    )
    pixels, _ = scene.cameras.project(torch.from_numpy(POINTS).float())
    np.testing.assert_allclose(pixels, np.stack([2 * project(pose)[:, :2] for pose in poses]), atol=2e-3)
    assert_colours_found(read(tmp_path, image_size=[40, 56]).load(0, [0]), 0)


def test_crop_and_resize_keep_points_on_their_pixels(tmp_path):
    poses = write_nerfstudio(tmp_path)
    scene = read(tmp_path, crop=32, image_size=[64, 48]).load(0, truth=True)
    assert scene.pixels.shape == (6, 3, 64, 48) and scene.mask.shape == (6, 64, 48)
    pixels, _ = scene.cameras.project(torch.from_numpy(POINTS).float())
    expected = np.stack([(project(pose)[:, :2] - [12, 4]) * [1.5, 2] for pose in poses])
    np.testing.assert_allclose(pixels, expected, atol=2e-3)


def test_images_at_another_resolution_than_stated(tmp_path):
    write_nerfstudio(tmp_path)
    edit(tmp_path / "transforms.json", lambda c: c.update(fl_x=2 * FX, fl_y=2 * FY, cx=2 * CX, cy=2 * CY, w=112, h=80))
    assert_colours_found(read(tmp_path).load(0), 0)


def test_masks_put_the_rest_on_white(tmp_path):
    write_nerfstudio(tmp_path)
    scene = read(tmp_path).load(0, truth=True)
    plain = read(tmp_path, white_background=False).load(0, truth=True)
    assert torch.equal(scene.mask, plain.mask)
    outside = ~scene.mask[:, None].expand_as(scene.pixels)
    assert (scene.pixels[outside] == 255).all() and (plain.pixels[outside] == 90).all()
    assert torch.equal(scene.pixels[~outside], plain.pixels[~outside])


def repaint_masks(folder, change) -> None:
    for file in (folder / "masks").iterdir():
        Image.fromarray(change(np.asarray(Image.open(file)))).save(file)


def test_masks_of_the_other_polarity_are_refused_or_read_as_such(tmp_path):
    """Case 02: white where the background is, as instant-ngp marks what to leave out."""
    write_nerfstudio(tmp_path)
    right = read(tmp_path).load(0, truth=True)
    repaint_masks(tmp_path, lambda mask: 255 - mask)
    with pytest.raises(DataError, match=r"border in 6 of 6 views; they look inverted.*inverted_masks=true") as error:
        read(tmp_path).load(0)
    assert str(tmp_path) in str(error.value) and "\n" not in str(error.value)
    mended = read(tmp_path, inverted_masks=True)
    assert torch.equal(mended.load(0, truth=True).mask, right.mask)
    assert torch.equal(mended.load(0).pixels, right.pixels)
    assert mended.identity != read(tmp_path).identity  # a cache of the one is not taken for the other's
    assert (read(tmp_path, max_mask_border=None).load(0).pixels != right.pixels).any()
    assert (read(tmp_path, white_background=False).load(0).pixels == 90).any()
    assert read(tmp_path).load(0, [0]).pixels.shape[0] == 1  # single views tell nothing


@pytest.mark.parametrize(("level", "words"), [(0, "empty in every view"), (255, "cover all of every view")])
def test_masks_of_nothing_and_of_everything_are_refused(tmp_path, level, words):
    write_nerfstudio(tmp_path)
    repaint_masks(tmp_path, lambda mask: np.full_like(mask, level))
    with pytest.raises(DataError, match=words):
        read(tmp_path).load(0)


def test_an_alpha_of_which_nothing_is_transparent_is_no_mask(tmp_path):
    write_blender(tmp_path)
    assert read(tmp_path).load(0, truth=True).mask is not None
    for file in tmp_path.glob("*/*.png"):
        Image.open(file).convert("RGB").convert("RGBA").save(file)
    assert read(tmp_path).load(0, truth=True).mask is None


def test_without_masks_there_are_none(tmp_path):
    write_nerfstudio(tmp_path, masks=False)
    scene = read(tmp_path).load(0, truth=True)
    assert scene.mask is None and (scene.pixels == 90).any()


def test_views_are_read_in_the_order_asked_for(tmp_path):
    write_nerfstudio(tmp_path)
    reader = read(tmp_path)
    whole, part = reader.load(0, truth=True), reader.load(0, [4, 0, -2], truth=True)
    assert part.views == ("frame_00005", "frame_00001", "frame_00005")
    for key in ("pixels", "mask"):
        assert torch.equal(getattr(part, key), getattr(whole, key)[[4, 0, 4]])
    assert torch.equal(part.cameras.c2w, whole.cameras.c2w[[4, 0, 4]])


def test_only_the_views_asked_for_are_decoded(tmp_path):
    write_nerfstudio(tmp_path)
    (tmp_path / "images/frame_00002.png").write_bytes(b"damaged")
    assert read(tmp_path).load(0, [0, 2]).views == ("frame_00001", "frame_00003")


def test_a_single_scene_is_every_split(tmp_path):
    write_nerfstudio(tmp_path / "shoe")
    for root in (tmp_path, tmp_path / "shoe"):
        for split in ("train", "val", "test"):
            assert [read(root, split).scene_id(0)] == ["shoe"] and len(read(root, split)) == 1


def test_a_folder_given_as_a_dot_has_a_name(tmp_path, monkeypatch):
    write_nerfstudio(tmp_path / "shoe")
    monkeypatch.chdir(tmp_path / "shoe")
    assert read(".").scene_id(0) == "shoe"


def test_splits_may_be_folders(tmp_path):
    for k, name in enumerate(("train/a", "train/b", "test/c")):
        write_nerfstudio(tmp_path / name, views=2, seed=k)
    assert [read(tmp_path).scene_id(i) for i in range(2)] == ["a", "b"] and len(read(tmp_path)) == 2
    assert read(tmp_path, "test").scene_id(0) == "c"
    with pytest.raises(MissingSplit, match=r"no val split; found only test, train"):
        read(tmp_path, "val")


def test_scenes_side_by_side_are_shared_out(tmp_path):
    write_nerfstudio(tmp_path / "s0", views=2)
    for k in range(1, 10):
        shutil.copytree(tmp_path / "s0", tmp_path / f"s{k}")
    (tmp_path / ".cache").mkdir()
    (tmp_path / "notes.txt").touch()

    def names(split, **changes):
        reader = read(tmp_path, split, **changes)
        return [reader.scene_id(i) for i in range(len(reader))]

    parts = [names(split) for split in ("train", "val", "test")]
    assert [len(part) for part in parts] == [8, 1, 1]
    assert sorted(name for part in parts for name in part) == [f"s{k}" for k in range(10)]
    assert names("train") == parts[0] != names("train", split_seed=1)
    assert len(names("test", split_sizes={"train": 1, "test": 1})) == 5


def test_too_few_scenes_for_a_split(tmp_path):
    for k in range(2):
        write_nerfstudio(tmp_path / f"s{k}", views=2)
    with pytest.raises(MissingSplit, match=r"2 scenes are too few for a test split of 10 in 100.*folders train, val"):
        read(tmp_path, "test")


def test_bounds_are_estimated_and_said(tmp_path, caplog):
    write_nerfstudio(tmp_path / "shoe", views=20)
    with caplog.at_level(logging.INFO, "nerfdiff.data.readers.posed_images"):
        scene = read(tmp_path).load(0, [0])
    radius = 3 * math.sin(math.atan(WIDTH / 2 / FX))
    assert scene.near == pytest.approx(2.8 - radius, abs=0.15) and scene.far == pytest.approx(3.2 + radius, abs=0.15)
    (said,) = caplog.messages
    assert f"those of shoe are {scene.near:.4g} and {scene.far:.4g}" in said and "data.reader.near" in said


@pytest.mark.parametrize("stated", [True, False])
def test_bounds_enclose_what_the_widest_view_shows(tmp_path, stated):
    write_nerfstudio(tmp_path, views=20, per_frame=True)

    def widen(content):
        for frame in content["frames"] if not stated else ():
            del frame["w"], frame["h"]
        content["frames"][3] |= {"fl_x": FX / 3, "fl_y": FY / 3}

    narrow = read(tmp_path).load(0, [0])
    edit(tmp_path / "transforms.json", widen)
    wide = read(tmp_path).load(0, [0])
    radius = 3 * math.sin(math.atan(WIDTH / 2 / (FX / 3)))
    assert wide.near < narrow.near and wide.far == pytest.approx(3.2 + radius, abs=0.15)
    cropped = read(tmp_path, crop=20).load(0, [0])  # shows less of the object, but all of its depth
    assert (cropped.near, cropped.far) == (wide.near, wide.far)


def test_bounds_come_from_the_file_or_from_the_config(tmp_path, caplog):
    write_nerfstudio(tmp_path / "stated", near=1.0, far=5.0)
    assert [getattr(read(tmp_path).load(0, [0]), key) for key in ("near", "far")] == [1.0, 5.0]
    assert [getattr(read(tmp_path, far=7.0).load(0, [0]), key) for key in ("near", "far")] == [1.0, 7.0]
    caplog.clear()
    with caplog.at_level(logging.INFO, "nerfdiff.data.readers.posed_images"):
        assert [getattr(read(tmp_path, near=2, far=9).load(0, [0]), key) for key in ("near", "far")] == [2.0, 9.0]
    assert not caplog.messages
    with pytest.raises(DataError, match=r"stated: near = 6 and far = 5, partly.*set both data\.reader\.near"):
        read(tmp_path, near=6.0)


def test_forward_facing_captures_need_bounds(tmp_path):
    write_nerfstudio(tmp_path, views=4)

    def line_up(content):
        for k, frame in enumerate(content["frames"]):
            frame["transform_matrix"] = np.eye(4).tolist()
            frame["transform_matrix"][0][3] = 0.1 * k

    edit(tmp_path / "transforms.json", line_up)
    with pytest.raises(DataError, match=r"near and far cannot be estimated.*set data\.reader\.near"):
        read(tmp_path)
    assert read(tmp_path, near=1.0, far=4.0).load(0).far == 4.0


def test_another_convention_is_refused_and_can_be_said(tmp_path):
    poses = write_nerfstudio(tmp_path / "a")

    def convert(content):
        for frame, pose in zip(content["frames"], poses, strict=True):
            frame["transform_matrix"] = (pose @ np.diag([1, -1, -1, 1])).tolist()

    edit(tmp_path / "a/transforms.json", convert)
    with pytest.raises(DataError, match=r"a: 6 of 6 cameras look away.*data\.reader\.convention=opencv"):
        read(tmp_path)
    assert_colours_found(read(tmp_path, convention="opencv").load(0), 0)
    assert read(tmp_path, inward=False, near=1.0, far=2.0).load(0).near == 1.0


def test_outward_captures_can_be_read(tmp_path):
    write_nerfstudio(tmp_path)

    def turn(content):
        for frame in content["frames"]:
            matrix = np.array(frame["transform_matrix"]) @ np.diag([-1, 1, -1, 1])
            frame["transform_matrix"] = matrix.tolist()

    edit(tmp_path / "transforms.json", turn)
    with pytest.raises(DataError, match="inward=false"):
        read(tmp_path, near=1.0, far=2.0)
    assert len(read(tmp_path, near=1.0, far=2.0, inward=False).load(0).views) == 6


def test_suffixes_and_jpegs(tmp_path):
    write_nerfstudio(tmp_path, suffix=".jpg", masks=False)
    edit(
        tmp_path / "transforms.json",
        lambda c: [f.update(file_path=f["file_path"].removesuffix(".jpg")) for f in c["frames"]],
    )
    scene = read(tmp_path).load(0)
    assert scene.views[0] == "frame_00001" and scene.pixels.shape == (6, 3, HEIGHT, WIDTH)


def test_memory_does_not_grow_with_the_dataset(tmp_path, monkeypatch):
    monkeypatch.setattr(posed_images, "KEPT_SCENES", 2)
    for k in range(5):
        write_nerfstudio(tmp_path / f"train/s{k}", views=2, seed=k)
    reader = read(tmp_path)
    centres = [reader.load(k).cameras.centres for k in (0, 1, 2, 3, 4, 0)]
    assert len(reader._parsed) <= 2 and torch.equal(centres[0], centres[5])
    assert torch.equal(pickle.loads(pickle.dumps(reader)).load(4).cameras.centres, centres[4])


def test_fingerprint_and_identity(tmp_path):
    write_blender(tmp_path / "data/lego")
    root = tmp_path / "data"
    first = read(root).fingerprint()
    assert read(root).fingerprint() == first
    shutil.copy(root / "lego/train/r_0.png", root / "lego/train/r_1.png.new")
    os.replace(root / "lego/train/r_1.png.new", root / "lego/train/r_1.png")
    second = read(root).fingerprint()
    edit(root / "lego/transforms_val.json", lambda c: c["frames"].pop())
    assert len({first, second, read(root).fingerprint()}) == 3
    readers = [
        read(root),
        read(root / "lego"),
        read(root, "test"),
        read(root, near=1.0),
        read(root, white_background=False),
        read(root, missing_images="skip"),
        read(root, image_size=32),
        read(root, convention="opencv", inward=False, near=1.0, far=2.0),
    ]
    assert len({reader.identity for reader in readers}) == len(readers)


def test_the_image_cache_keeps_each_scenes_bounds(tmp_path):
    for k in range(2):
        write_nerfstudio(tmp_path / f"data/train/s{k}", views=3, seed=k)
    reader = read(tmp_path / "data")
    cached = CachedReader(reader, tmp_path / "cache", "posed")
    for k in range(2):
        here, there = cached.load(k), reader.load(k)
        assert torch.equal(here.pixels, there.pixels) and torch.equal(here.cameras.K, there.cameras.K)
        assert (here.near, here.far) == (there.near, there.far)
    assert reader.load(0).near != reader.load(1).near


def test_a_stray_camera_is_named_and_does_not_set_the_bounds(tmp_path, caplog):
    """Case 05: far went from 1.87 to 26.6 for all views."""
    write_nerfstudio(tmp_path, views=12)
    right = read(tmp_path).load(0)

    def scatter(content):
        for row in content["frames"][3]["transform_matrix"][:3]:
            row[3] *= 20

    assert "stray" not in caplog.text
    edit(tmp_path / "transforms.json", scatter)
    found = read(tmp_path).load(0)
    assert (found.near, found.far) == pytest.approx((right.near, right.far), rel=0.05)
    assert "stray cameras: view frame_00004 is" in caplog.text and "data.reader.near" in caplog.text
    caplog.clear()
    assert read(tmp_path, near=1.0, far=90.0).load(0).far == 90.0 and "stray" not in caplog.text


def test_the_configuration_reads_a_scene(tmp_path):
    write_nerfstudio(tmp_path, scales=(1, 2))
    cfg = load_config("train", ["data=posed_images", f"data.root={tmp_path}", "data.reader.far=9.5"])
    reader = instantiate(cfg.data.reader)(root=cfg.data.root, split="val", image_size=cfg.data.image_size)
    scene = reader.load(0)
    assert scene.pixels.shape == (6, 3, 128, 128) and scene.far == 9.5
    assert len(pickle.dumps(reader)) < 20000


def lose(folder, *numbers: int) -> None:
    for number in numbers:
        (folder / f"images/frame_{number:05d}.png").unlink()


def test_frames_without_a_file_are_counted_and_can_be_left_out(tmp_path, caplog):
    poses = write_nerfstudio(tmp_path / "fox", views=12)
    lose(tmp_path / "fox", 1, 3, 4, 5, 9)
    with pytest.raises(DataError) as error:
        read(tmp_path)
    assert "fox: 5 of 12 listed images or their masks are not there: images/frame_00001.png, " in str(error.value)
    assert "and 2 more" in str(error.value) and "data.reader.missing_images=skip" in str(error.value)
    for _ in range(2):
        scene = read(tmp_path, missing_images="skip", image_size=[40, 56]).load(0, truth=True)
    assert scene.views == tuple(f"frame_{k:05d}" for k in (2, 6, 7, 8, 10, 11, 12))
    expected = np.stack([project(poses[int(view[-5:]) - 1])[:, :2] for view in scene.views])
    pixels, _ = scene.cameras.project(torch.from_numpy(POINTS).float())
    np.testing.assert_allclose(pixels, expected, atol=1e-3)
    assert_colours_found(scene, 0)
    assert caplog.text.count("5 of 12 listed images") == 1


def test_frames_without_their_mask_are_left_out_as_well(tmp_path):
    write_nerfstudio(tmp_path)
    (tmp_path / "masks/frame_00002.png").rename(tmp_path / "masks/frame_00002.PNG")
    (tmp_path / "masks/frame_00003.png").unlink()
    assert len(read(tmp_path, missing_images="skip").load(0, truth=True).views) == 5


def test_a_scene_without_any_image_is_an_error_all_the_same(tmp_path):
    write_nerfstudio(tmp_path)
    shutil.rmtree(tmp_path / "images")
    with pytest.raises(DataError, match=r"6 of 6 listed images") as error:
        read(tmp_path, missing_images="skip")
    assert "missing_images" not in str(error.value)


def test_files_of_a_camera_that_writes_large_letters_are_found(tmp_path):
    write_nerfstudio(tmp_path, masks=False)
    for file in (tmp_path / "images").iterdir():
        file.rename(file.with_suffix(".PNG"))
    edit(
        tmp_path / "transforms.json",
        lambda c: [f.update(file_path=f["file_path"].removesuffix(".png")) for f in c["frames"]],
    )
    assert_colours_found(read(tmp_path).load(0), 0)


def turn(folder, orientation: int = 6) -> None:
    """Store the images lying on their left side, and say so in their EXIF."""
    for file in (folder / "images").iterdir():
        with Image.open(file) as image:
            lying = image.transpose(Image.Transpose.ROTATE_90)
        exif = lying.getexif()
        exif[0x0112] = orientation
        lying.save(file, exif=exif)


def test_images_stored_lying_are_read_upright_if_their_cameras_are(tmp_path):
    """As phones store them, with a file for the upright pictures."""
    write_nerfstudio(tmp_path, masks=False)
    turn(tmp_path)
    assert_colours_found(read(tmp_path).load(0), 0)
    edit(tmp_path / "transforms.json", lambda c: c.update(fl_x=2 * FX, fl_y=2 * FY, cx=2 * CX, cy=2 * CY, w=112, h=80))
    assert_colours_found(read(tmp_path).load(0), 0)


def test_images_stored_lying_are_read_so_if_their_cameras_are(tmp_path):
    """As COLMAP sees them, which does not look at EXIF."""
    poses = write_nerfstudio(tmp_path, masks=False)
    turn(tmp_path)

    def lie_down(content):
        content |= {"fl_x": FY, "fl_y": FX, "cx": CY, "cy": WIDTH - CX, "w": HEIGHT, "h": WIDTH}
        for frame, pose in zip(content["frames"], poses, strict=True):
            right, up, backward, centre = pose.T
            frame["transform_matrix"] = np.stack([-up, right, backward, centre], 1).tolist()

    edit(tmp_path / "transforms.json", lie_down)
    scene = read(tmp_path).load(0)
    assert scene.pixels.shape[-2:] == (WIDTH, HEIGHT)
    assert_colours_found(scene, 0)


def test_without_a_size_a_lying_image_is_refused(tmp_path):
    write_nerfstudio(tmp_path, masks=False)
    turn(tmp_path)
    edit(tmp_path / "transforms.json", lambda c: [c.pop("w"), c.pop("h")])
    with pytest.raises(
        DataError, match=r"frame_00001\.png: its EXIF tag Orientation is 6.*states no size.*'w' and 'h'"
    ):
        read(tmp_path).load(0)


CASES = {
    "truncated image": ("images/frame_00002.png", lambda f: f.write_bytes(f.read_bytes()[:-60]), "not a whole image"),
    "missing image": ("images/frame_00002.png", lambda f: f.unlink(), "1 of 6 listed images or their masks are not"),
    "missing mask": ("masks/frame_00002.png", lambda f: f.unlink(), "1 of 6 listed images or their masks are not"),
    "other size": (
        "images/frame_00002.png",
        lambda f: Image.fromarray(np.zeros((20, 28, 3), np.uint8)).save(f),
        "20x28",
    ),
    "small mask": (
        "masks/frame_00002.png",
        lambda f: Image.fromarray(np.zeros((9, 9), np.uint8)).save(f),
        r"frame_00002\.png: 9x9 pixels, its image frame_00002\.png has 40x56",
    ),
    "portrait": (
        "images/frame_00002.png",
        lambda f: Image.fromarray(np.zeros((WIDTH, HEIGHT, 3), np.uint8)).save(f),
        r"frames\[1\] \(images/frame_00002\.png\): intrinsics are for w x h = 56x40, but the image is 40x56",
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_damaged_files(tmp_path, name):
    write_nerfstudio(tmp_path / "a")
    file, change, message = CASES[name]
    change(tmp_path / "a" / file)
    with pytest.raises(DataError, match=message) as error:
        read(tmp_path).load(0)
    assert str(tmp_path / "a") in str(error.value) and "\n" not in str(error.value)
    assert "frame_00002" in str(error.value)


def test_wrong_roots(tmp_path):
    with pytest.raises(DataError, match=r"nowhere: no such folder; set data\.root.*transforms\.json"):
        read(tmp_path / "nowhere")
    with pytest.raises(DataError, match=r"no scenes; expected one folder per scene.*transforms\.json"):
        read(tmp_path)
    (tmp_path / "a").mkdir()
    with pytest.raises(DataError, match=r"a: no transforms\.json"):
        read(tmp_path)
    (tmp_path / "train").mkdir()
    with pytest.raises(DataError, match="train: the split is empty"):
        read(tmp_path)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"split": "dev"}, "'dev' is unknown; choose one of train, val, test"),
        ({"near": 2.0, "far": 1.0}, "0 < near < far"),
        ({"near": 0.0}, "0 < near < far"),
        ({"far": float("nan")}, "0 < near < far"),
        ({"missing_images": "ignore"}, "'ignore' is unknown; choose one of error, skip"),
        ({"convention": "colmap"}, "'colmap' is unknown; choose one of opengl, opencv"),
        ({"image_size": 0}, "image_size"),
    ],
)
def test_settings_that_make_no_sense(tmp_path, changes, message):
    write_nerfstudio(tmp_path)
    with pytest.raises(ConfigError, match=message):
        read(tmp_path, **{"split": "train", **changes})
