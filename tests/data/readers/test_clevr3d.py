"""The Clevr3D reader on layouts whose every pixel is known, and on damaged ones."""

import multiprocessing
import os
import pickle
import shutil

import numpy as np
import pytest
import torch
from hydra.utils import instantiate
from PIL import Image

from clevr_fixtures import (
    BALL,
    COLOURS,
    FAR,
    HEIGHT,
    NEAR,
    POINTS,
    RADIUS,
    SETTINGS,
    WIDTH,
    draw,
    project,
    write_clevr3d,
)
from nerfdiff.cli import load_config
from nerfdiff.data.readers.clevr3d import Clevr3DReader
from nerfdiff.data.scene import MissingSplit, SceneReader
from nerfdiff.utils.errors import ConfigError, DataError

SPLITS = {"train": [0, 2], "val": [2, 3], "test": [3, 4]}


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    root = tmp_path_factory.mktemp("clevr3d")
    return root, write_clevr3d(root)


@pytest.fixture
def root(dataset, tmp_path):
    """A copy to change."""
    shutil.copytree(dataset[0], tmp_path / "data")
    return tmp_path / "data"


def read(root, split="train", **changes) -> Clevr3DReader:
    return Clevr3DReader(root, split, **{"splits": SPLITS, **SETTINGS, **changes})


def test_scenes_hold_exactly_what_was_written(dataset):
    root, positions = dataset
    reader = read(root)
    assert isinstance(reader, SceneReader) and len(reader) == 2
    assert reader.scene_id(1) == "1" and reader.view_names(1) == ("0", "1", "2")
    scene = reader.load(1)
    assert (scene.id, scene.near, scene.far, scene.mask, scene.depth) == ("1", NEAR, FAR, None, None)
    assert np.array_equal(scene.pixels.permute(0, 2, 3, 1), np.stack([draw(position) for position in positions[1]]))
    np.testing.assert_allclose(scene.cameras.centres, positions[1], rtol=1e-6)
    assert torch.equal(scene.cameras.K[0], torch.tensor([[350.0, 0, 160], [0, 350, 120], [0, 0, 1]]))
    assert read(root, "test").load(0).id == "3"


@pytest.mark.parametrize("framing", [{}, {"image_size": [120, 160]}, {"crop": [192, 256], "image_size": 64}])
def test_known_points_lie_on_their_pixels(dataset, framing):
    root, positions = dataset
    for index in range(2):
        cameras = read(root, **framing).load(index).cameras
        pixels, depth = cameras.project(torch.from_numpy(POINTS).float())
        expected = np.stack([project(position) for position in positions[index]])
        if "crop" in framing:
            expected[..., :2] -= (32, 24)
        expected[..., :2] *= np.array([cameras.width, cameras.height]) / framing.get("crop", [HEIGHT, WIDTH])[::-1]
        np.testing.assert_allclose(pixels, expected[..., :2], atol=1e-3)
        np.testing.assert_allclose(depth, expected[..., 2], atol=1e-4)


def test_rays_through_pixels_come_back_to_them(dataset):
    root, positions = dataset
    rays = read(root).load(0).cameras.rays(NEAR, FAR)
    for row, column in ((0, 0), (17, 300), (239, 5), (120, 160)):
        points = (rays.origins + 9 * rays.directions)[:, row, column].double().numpy()
        for position, point in zip(positions[0], points, strict=True):
            np.testing.assert_allclose(project(position, point[None])[0, :2], [column + 0.5, row + 0.5], atol=1e-3)


def test_colours_lie_where_points_project(dataset):
    scene = read(dataset[0], image_size=[120, 160]).load(0)
    pixels, _ = scene.cameras.project(torch.from_numpy(POINTS).float())
    for view in range(3):
        for point in range(1, len(POINTS)):
            column, row = pixels[view, point].floor().long()
            difference = scene.pixels[view, :, row, column].int() - torch.from_numpy(COLOURS[point]).int()
            assert difference.abs().max() <= 2


@pytest.mark.parametrize("image_size", [None, [120, 160]])
def test_depth_and_mask_put_the_surfaces_where_they_are(dataset, image_size):
    """Every pixel's depth leads to a point on the floor or on the ball, whatever view it is seen from."""
    scene = read(dataset[0], image_size=image_size).load(1, truth=True)
    rays = scene.cameras.rays(NEAR, FAR)
    cosine = (rays.directions * scene.cameras.c2w[:, None, None, :3, 2]).sum(-1)
    assert scene.depth.shape == scene.mask.shape == scene.pixels[:, 0].shape
    points = (rays.origins + (scene.depth / cosine)[..., None] * rays.directions).double()
    to_ball = (points - torch.from_numpy(BALL)).norm(dim=-1)
    step = 40 / 65536
    # halved by nearest neighbour, a depth is that of a ray half a pixel away
    tolerance = step if image_size is None else 0.1
    ball, floor = scene.mask, ~scene.mask & (scene.depth > 0)  # floor that is farther than 40 has no depth
    assert 100 < ball.sum() < 0.2 * ball.numel() < floor.sum()
    assert points[floor][:, 2].abs().max() < tolerance
    assert (to_ball[ball] - RADIUS).abs().mean() < tolerance and (to_ball[floor] > RADIUS - tolerance).all()


def test_depth_agrees_between_views(dataset):
    """Floor that one view sees is where another sees it: its depth there is that of the point."""
    scene = read(dataset[0]).load(0, truth=True)
    rays = scene.cameras.rays(NEAR, FAR)
    cosine = (rays.directions * scene.cameras.c2w[:, None, None, :3, 2]).sum(-1)
    points = rays.origins + (scene.depth / cosine)[..., None] * rays.directions
    floor = points[0][~scene.mask[0] & (scene.depth[0] > 0)]
    pixels, depth = scene.cameras[1:2].project(floor[None])
    column, row = pixels[0].floor().long().unbind(-1)
    inside = (column >= 0) & (column < WIDTH) & (row >= 0) & (row < HEIGHT) & (depth[0] > 0)
    column, row, depth = column[inside], row[inside], depth[0][inside]
    seen = ~scene.mask[1, row, column] & (scene.depth[1, row, column] > 0)
    assert seen.sum() > 10000
    difference = (scene.depth[1, row, column] - depth)[seen] / depth[seen]
    assert difference.abs().median() < 2e-3 and difference.abs().max() < 0.02


def test_depth_beyond_the_files_range_is_none(root):
    file = root / "depths/depths_0_1.png"
    Image.fromarray(np.array([[65535, 65534], [0, 1]], np.uint16).repeat(120, 0).repeat(160, 1)).save(file)
    depth = read(root).load(0, [1], truth=True).depth[0]
    assert (depth[0, :160] == 0).all() and (depth[120:, :160] == 0).all()
    assert depth[0, 160:].min() > 30 and depth[120:, 160:].max() < 7e-4


@pytest.mark.parametrize("mode", ["1", "P", "I;16"])
def test_labels_may_be_stored_in_several_ways(root, mode):
    labels = np.zeros((HEIGHT, WIDTH), np.uint16 if mode == "I;16" else np.uint8)
    labels[10:20, 30:50] = 1 if mode == "1" else 7
    image = Image.fromarray(labels > 0) if mode == "1" else Image.fromarray(labels)
    if mode == "P":
        image.putpalette([0, 0, 0] * 256)  # what colours labels are shown in says nothing
    image.save(root / "masks/masks_0_0.png")
    assert Image.open(root / "masks/masks_0_0.png").mode == mode
    assert np.array_equal(read(root).load(0, [0], truth=True).mask[0], labels > 0)


def test_truth_is_optional(tmp_path):
    write_clevr3d(tmp_path, scenes=4, truth=False)
    scene = read(tmp_path).load(0, truth=True)
    assert scene.mask is None and scene.depth is None


def test_images_of_half_the_size_have_half_the_focal_length(tmp_path):
    positions = write_clevr3d(tmp_path, height=120, width=160)
    scene = read(tmp_path).load(0, truth=True)
    assert torch.equal(scene.cameras.K[0], torch.tensor([[175.0, 0, 80], [0, 175, 60], [0, 0, 1]]))
    assert np.array_equal(scene.pixels[0].permute(1, 2, 0), draw(positions[0, 0], 120, 160))


def test_views_are_read_in_the_order_asked_for(dataset):
    reader = read(dataset[0])
    whole, part = reader.load(0, truth=True), reader.load(0, [2, 0, -1], truth=True)
    assert part.views == ("2", "0", "2")
    for key in ("pixels", "depth", "mask"):
        assert torch.equal(getattr(part, key), getattr(whole, key)[[2, 0, 2]])
    assert torch.equal(part.cameras.c2w, whole.cameras.c2w[[2, 0, 2]])
    with pytest.raises(IndexError):
        reader.load(0, [3])


def test_the_top_folder_may_be_the_archives(tmp_path):
    write_clevr3d(tmp_path / "clevr3d")
    assert len(read(tmp_path)) == 2


@pytest.mark.parametrize(("limits", "kept"), [((None, 2), "01"), ((3, None), "23"), ((2, 3), "12"), ((4, 4), "3")])
def test_scenes_are_filtered_by_their_number_of_objects(dataset, limits, kept):
    reader = read(dataset[0], splits={"train": [0, 4]}, min_objects=limits[0], max_objects=limits[1])
    assert [reader.scene_id(i) for i in range(len(reader))] == list(kept)
    np.testing.assert_allclose(reader.load(0).cameras.centres, dataset[1][int(kept[0])], rtol=1e-6)
    assert reader.identity != read(dataset[0], splits={"train": [0, 4]}).identity


def test_a_filter_that_leaves_nothing_says_what_there_is(dataset):
    with pytest.raises(DataError, match=r"no scene of split train has 5 to 9 objects, but 1 to 2"):
        read(dataset[0], min_objects=5, max_objects=9)


def test_only_what_is_needed_is_unpacked(root):
    """An array that cannot be read, or is missing, matters only to those who ask for it."""
    with np.load(root / "metadata.npz") as arrays:
        camera_pos = arrays["camera_pos"]
    np.savez(root / "metadata.npz", camera_pos=camera_pos, odd=np.array([{"a": 1}], dtype=object))
    assert len(read(root)) == 2
    with pytest.raises(DataError, match=r"metadata\.npz: expected an npz file with an array 'shape' \[4, objects\]"):
        read(root, max_objects=3)


def test_a_hundred_thousand_scenes_are_not_listed_and_travel_light(tmp_path, monkeypatch):
    (tmp_path / "images").mkdir()
    camera_pos = np.tile(np.array([[[7.0, -6, 5], [-8, 1, 5], [1, 8, 5]]]), (100000, 1, 1))
    np.savez(tmp_path / "metadata.npz", camera_pos=camera_pos, shape=np.ones((100000, 10), np.int8))
    looked_at = []
    with monkeypatch.context() as patch:
        for name in ("scandir", "listdir"):
            patch.setattr(os, name, lambda *_: pytest.fail("a folder was listed"))
        stat = os.stat
        patch.setattr(os, "stat", lambda path, *a, **k: looked_at.append(path) or stat(path, *a, **k))
        reader = read(tmp_path, splits={"train": [0, 70000]}, max_objects=10)
        reader.fingerprint()
    assert 0 < len(looked_at) < 30  # however many images there are
    assert len(reader) == 70000 and len(pickle.dumps(reader)) < 3.5e6
    assert len(pickle.loads(pickle.dumps(reader))) == 70000


def test_a_spawned_process_reads_the_same(dataset):
    reader = read(dataset[0])
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        there = pool.apply(reader.load, (0, [1], True))
    assert torch.equal(there.pixels, reader.load(0, [1]).pixels)


def test_fingerprint_and_identity(root, tmp_path):
    first = read(root).fingerprint()
    assert read(root).fingerprint() == first == read(root, "test").fingerprint()
    os.replace(root / "images/img_0_0.png", root / "images/img_9_0.png")
    assert read(root).fingerprint() != first
    shutil.copytree(root, tmp_path / "other")
    identities = [
        read(root).identity,
        read(tmp_path / "other").identity,
        read(root, "test").identity,
        read(root, image_size=64).identity,
        read(root, focal=300.0).identity,
        read(root, far=21.0).identity,
    ]
    assert len(set(identities)) == len(identities)


def rewrite(root, **changes) -> None:
    with np.load(root / "metadata.npz") as arrays:
        content = dict(arrays) | changes
    np.savez(root / "metadata.npz", **{key: value for key, value in content.items() if value is not None})


def with_position(root, scene: int, view: int, position) -> None:
    with np.load(root / "metadata.npz") as arrays:
        camera_pos = arrays["camera_pos"]
    camera_pos[scene, view] = position
    rewrite(root, camera_pos=camera_pos)


def truncate(file) -> None:
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])


def save(array):
    return lambda file: Image.fromarray(array).save(file)


FILES = {
    "truncated image": ("images/img_1_2.png", truncate, r"images/img_1_2\.png: not a whole image"),
    "missing image": ("images/img_1_2.png", lambda f: f.unlink(), r"images/img_1_2\.png: no such image"),
    "other aspect": ("images/img_1_2.png", save(np.zeros((240, 240, 3), np.uint8)), r"img_1_2\.png.*another aspect"),
    "other size": ("images/img_1_2.png", save(np.zeros((120, 160, 3), np.uint8)), r"img_1_2\.png: 120x160.*image_size"),
    "missing depth": ("depths/depths_1_0.png", lambda f: f.unlink(), r"depths/depths_1_0\.png: no such image"),
    "depth of 8 bits": ("depths/depths_1_0.png", save(np.zeros((240, 320), np.uint8)), r"depths_1_0\.png.*16 bits"),
    "coloured depth": ("depths/depths_1_0.png", save(np.zeros((240, 320, 3), np.uint8)), r"depths_1_0\.png.*channel"),
    "small depth": ("depths/depths_1_0.png", save(np.zeros((9, 9), np.uint16)), r"depths_1_0\.png: 9x9.*240x320"),
    "small mask": ("masks/masks_1_0.png", save(np.zeros((9, 9), np.uint8)), r"masks_1_0\.png: 9x9.*240x320"),
    "coloured mask": ("masks/masks_1_0.png", save(np.zeros((240, 320, 3), np.uint8)), r"masks_1_0\.png.*one channel"),
}


@pytest.mark.parametrize("name", FILES)
def test_damaged_files(root, name):
    file, change, message = FILES[name]
    change(root / file)
    with pytest.raises(DataError, match=message) as error:
        read(root).load(1, truth=True)
    assert str(root) in str(error.value) and "\n" not in str(error.value)
    read(root).load(0, truth=True)


def positions_of(dtype=np.float64, shape=(4, 3, 3)) -> np.ndarray:
    return np.ones(shape).astype(dtype)


METADATA = {
    "truncated": (lambda r: truncate(r / "metadata.npz"), "expected an npz file"),
    "empty": (lambda r: (r / "metadata.npz").write_bytes(b""), "expected an npz file"),
    "text": (lambda r: (r / "metadata.npz").write_text("camera_pos"), "expected an npz file"),
    "no camera_pos": (lambda r: rewrite(r, camera_pos=None), r"array 'camera_pos' \[scenes, views, 3\]"),
    "flat": (lambda r: rewrite(r, camera_pos=positions_of(shape=(4, 9))), r"found shape \[4, 9\]"),
    "words": (lambda r: rewrite(r, camera_pos=positions_of(str)), "expected numbers in 'camera_pos'"),
    "objects": (lambda r: rewrite(r, camera_pos=positions_of(object)), "expected an npz file"),
    "nan": (lambda r: with_position(r, 1, 2, [np.nan, 1, 2]), r"scene 1, view 2 is \[nan, 1.0, 2.0\]"),
    "infinite": (lambda r: with_position(r, 1, 2, [1e300, 1, 2]), r"scene 1, view 2 is \[inf"),
    "at the origin": (lambda r: with_position(r, 0, 1, [0, 0, 0]), "scene 0, view 1.*off the z axis"),
    "straight above": (lambda r: with_position(r, 0, 1, [0, 0, 9]), "scene 0, view 1.*off the z axis"),
    "fewer cameras than images": (
        lambda r: rewrite(r, camera_pos=positions_of(shape=(4, 2, 3))),
        r"img_0_2\.png: an image without a camera: .*metadata\.npz has 2 cameras",
    ),
    "no images": (lambda r: shutil.rmtree(r / "images"), "images: no such folder"),
}


@pytest.mark.parametrize("name", METADATA)
def test_damaged_metadata(root, name):
    change, message = METADATA[name]
    change(root)
    with pytest.raises(DataError, match=message) as error:
        read(root)
    assert str(root) in str(error.value) and "\n" not in str(error.value)


def test_positions_of_other_splits_do_not_matter(root):
    with_position(root, 3, 0, [np.nan] * 3)
    assert len(read(root)) == 2
    with pytest.raises(DataError, match="scene 3, view 0"):
        read(root, "test")


def test_wrong_roots(tmp_path):
    with pytest.raises(DataError, match=r"nowhere: no such folder.*data\.root.*metadata\.npz"):
        read(tmp_path / "nowhere")
    with pytest.raises(DataError, match=r"expected metadata\.npz.*an empty folder"):
        read(tmp_path)
    (tmp_path / "cars_train").mkdir()
    with pytest.raises(DataError, match=r"expected metadata\.npz.*found cars_train"):
        read(tmp_path)


def test_splits_that_the_dataset_has_not(dataset):
    with pytest.raises(
        MissingSplit, match=r"metadata\.npz: 4 scenes, but the val split is scenes 7 to 8;.*splits\.val"
    ):
        read(dataset[0], "val", splits={"train": [0, 4], "val": [7, 9]})
    with pytest.raises(DataError, match=r"4 scenes, but the train split is scenes 0 to 69999") as error:
        read(dataset[0], splits={"train": [0, 70000]})
    assert not isinstance(error.value, MissingSplit)  # part of it is there: no run should go on without the rest


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"split": "dev"}, "'dev' is unknown; choose one of train, val, test"),
        ({"near": 20.0}, "0 < near < far"),
        ({"near": float("nan")}, "0 < near < far"),
        ({"focal": 0.0}, "focal"),
        ({"stored_size": [240]}, "stored_size"),
        ({"splits": {"train": [3, 3]}}, r"splits\.train=\[3, 3\]"),
        ({"splits": {"train": [3]}}, r"splits\.train=\[3\]"),
        ({"image_size": 0}, "image_size"),
        ({"crop": [0, 4]}, "crop"),
    ],
)
def test_settings_that_make_no_sense(dataset, changes, message):
    with pytest.raises(ConfigError, match=message):
        read(dataset[0], **{"split": "train", **changes})


def test_the_configuration_reads_a_small_dataset(dataset):
    cfg = load_config(
        "train", ["data=clevr3d", f"data.root={dataset[0]}", "data.reader.splits={train:[0,3],val:[3,4],test:[3,4]}"]
    )
    assert cfg.data.background is None and cfg.data.source_target_noise == 0.3
    reader = instantiate(cfg.data.reader)(root=cfg.data.root, split="train", image_size=cfg.data.image_size)
    scene = reader.load(0)
    assert len(reader) == 3 and scene.pixels.shape == (3, 3, 120, 160)
    assert torch.equal(scene.cameras.K[0], torch.tensor([[175.0, 0, 80], [0, 175, 60], [0, 0, 1]]))
