"""The 30-view reader on layouts whose every pixel is known, and on damaged ones."""

import json
import logging
import math
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate
from PIL import Image

from abo_fixtures import (
    COLOURS,
    DISTANCE,
    POINTS,
    blender_camera,
    draw,
    project,
    visible,
    write_item,
    write_renders,
)
from nerfdiff.data.readers import item_folders as item_folders_module
from nerfdiff.data.readers.abo_renders import ABORenders
from nerfdiff.data.scene import MissingSplit, SceneReader
from nerfdiff.utils.errors import ConfigError, DataError

CONF = str(Path(__file__).parents[3] / "conf")
SETTINGS = {
    "split": "train",
    "near": 3.2,
    "far": 6.7,
    "distance": DISTANCE,
    "convention": "auto",
    "split_seed": 0,
    "split_sizes": {"train": 6743, "val": 396, "test": 794},
}
FLIP = np.diag([1.0, -1, -1, 1])


@pytest.fixture
def root(tmp_path):
    return tmp_path / "data"


def read(root, **changes) -> ABORenders:
    return ABORenders(root, index_dir=root.parent / "cache", **SETTINGS | changes)


def assert_points_found(scene, item, atol: float = 1e-3) -> int:
    """Known points, in the scene's units, project where Blender puts them, and their colours are there."""
    pixels, depth = scene.cameras.project(torch.from_numpy(POINTS).float())
    checked = 0
    for v, name in enumerate(scene.views):
        expected = project(item["poses"][int(name[-2:])], item["camera"], *item["size"], item["points"])
        np.testing.assert_allclose(pixels[v], expected[:, :2], atol=atol)
        np.testing.assert_allclose(depth[v], expected[:, 2] / item["scale"], rtol=1e-5)
        for k in visible(expected, *item["size"]):
            column, row = pixels[v, k].floor().long()
            assert scene.pixels[v, :, row, column].tolist() == COLOURS[k].tolist()
            checked += 1
    return checked


@pytest.mark.parametrize("bits", [8, 16])
def test_scene_holds_exactly_what_was_written(root, bits):
    items = write_renders(root, bits=bits)
    reader = read(root)
    assert isinstance(reader, SceneReader) and len(reader) == 6
    checked = 0
    for index in range(len(reader)):
        scene, item = reader.load(index), items[reader.scene_id(index)]
        assert scene.views == reader.view_names(index) == tuple(f"{scene.id}_{k:02d}" for k in range(4))
        assert (scene.near, scene.far, scene.mask, scene.depth) == (3.2, 6.7, None, None)
        drawn = [draw(project(pose, item["camera"], 64, 64, item["points"]), 64, 64) for pose in item["poses"]]
        on_white = [np.where(image[..., 3:] > 0, image[..., :3], 255) for image in drawn]
        assert np.array_equal(scene.pixels.permute(0, 2, 3, 1), np.stack(on_white))
        checked += assert_points_found(scene, item)
        masks = np.stack([image[..., 3] > 0 for image in drawn])
        assert np.array_equal(reader.load(index, truth=True).mask, masks)
    assert checked > 60


@pytest.mark.parametrize("form", ["opengl", "opencv", "opengl inverted", "opencv inverted"])
def test_conventions_are_told_apart(root, form, caplog):
    caplog.set_level(logging.INFO)

    def written(pose):
        pose = pose @ FLIP if "opencv" in form else pose
        return np.linalg.inv(pose) if "inverted" in form else pose

    items = write_renders(root, poses=written)
    reader = read(root)
    for index in range(3):
        scene = reader.load(index)
        assert_points_found(scene, items[scene.id])
        geometry = reader.geometry(index)
        np.testing.assert_allclose(geometry.centre, items[scene.id]["centre"], atol=1e-6)
        assert (geometry.convention, geometry.inverted) == (form.split()[0], "inverted" in form)
    (message,) = [record.message for record in caplog.records if "optical axes" in record.message]
    assert ("OpenCV axes" in message) == ("opencv" in form)
    assert ("world-to-camera" in message) == ("inverted" in form)


@pytest.mark.parametrize("size", [(64, 64), (48, 80), (80, 48)])
@pytest.mark.parametrize("fit", ["AUTO", "HORIZONTAL", "VERTICAL"])
def test_blenders_camera_parameters_are_honoured(root, size, fit):
    angle_y = 2 * math.atan(24 / 36 * math.tan(math.radians(35)))  # a sensor of 36 mm x 24 mm, 70° wide
    camera = blender_camera(angle_x=math.radians(70), angle_y=angle_y, sensor_height=24.0, sensor_fit=fit)
    item = write_item(root / "A", size=size, camera=camera | {"shift_x": 0.11, "shift_y": -0.07}, views=8)
    scene = read(root).load(0)
    assert (scene.cameras.height, scene.cameras.width) == size
    assert assert_points_found(scene, item) > 10


def test_the_releases_field_of_view(root):
    write_item(root / "A", size=(64, 64))
    K = read(root).load(0).cameras.K[0]
    f = 32 / math.tan(math.radians(20))
    torch.testing.assert_close(K, torch.tensor([[f, 0, 32], [0, f, 32], [0, 0, 1]]))
    f = 64 / math.tan(math.radians(20))
    half = read(root, image_size=128).load(0).cameras.K[0]
    torch.testing.assert_close(half, torch.tensor([[f, 0, 64], [0, f, 64], [0, 0, 1]]))


def test_a_crop_and_a_size_keep_points_at_their_projections(root):
    item = write_item(root / "A", size=(64, 80), views=6)
    reader = read(root, crop=[48, 64], image_size=[24, 32])
    scene = reader.load(0, truth=True)
    assert scene.pixels.shape == (6, 3, 24, 32) and scene.mask.shape == (6, 24, 32)
    pixels, _ = scene.cameras.project(torch.from_numpy(POINTS).float())
    checked = 0
    for v, pose in enumerate(item["poses"]):
        expected = project(pose, item["camera"], 64, 80, item["points"])
        np.testing.assert_allclose(pixels[v], (expected[:, :2] - 8) / 2, atol=1e-3)
        for k in visible(expected, 64, 80):
            column, row = pixels[v, k].floor().long()
            if 1 < row < 22 and 1 < column < 30:
                # the middle of a 5x5 square fills every 2x2 block that holds it
                assert scene.pixels[v, :, row, column].tolist() == COLOURS[k].tolist() and scene.mask[v, row, column]
                checked += 1
    assert checked > 10
    with pytest.raises(DataError, match="a crop of 65x65 does not fit into images of 64x80"):
        read(root, crop=65).load(0)


def test_views_are_read_in_the_order_asked_for(root):
    write_item(root / "A", views=5)
    reader = read(root)
    whole, part = reader.load(0), reader.load(0, [3, 0, -1])
    assert part.views == ("A_03", "A_00", "A_04")
    assert torch.equal(part.pixels, whole.pixels[[3, 0, 4]])
    assert torch.equal(part.cameras.c2w, whole.cameras.c2w[[3, 0, 4]])
    (root / "A/A_01.png").write_bytes(b"damaged")
    assert reader.load(0, [0, 2]).views == ("A_00", "A_02")


@pytest.mark.parametrize("truth", [False, True])
def test_each_image_is_decoded_once(root, truth, monkeypatch):
    write_item(root / "A", views=4)
    opened, open_image = [], Image.open
    monkeypatch.setattr(Image, "open", lambda file: opened.append(Path(file).name) or open_image(file))
    read(root).load(0, [2, 0], truth=truth)
    assert opened == ["A_02.png", "A_00.png"]


def test_images_without_alpha_have_no_mask(root):
    write_item(root / "A", views=2)
    Image.open(root / "A/A_00.png").convert("RGB").save(root / "A/A_00.png")
    assert read(root).load(0, truth=True).mask is None
    assert read(root).load(0, [1], truth=True).mask is not None


def test_depth_of_generated_copies_is_in_the_units_of_the_scene(root):
    item = write_item(root / "A", views=3)
    assert read(root).load(0, truth=True).depth is None
    (root / "A/depth").mkdir()
    stored = []
    for k, pose in enumerate(item["poses"]):
        projected = project(pose, item["camera"], 64, 64, item["points"])
        image, depth = draw(projected, 64, 64), np.zeros((64, 64), np.float32)
        for j in np.argsort(-projected[:, 2]):
            depth[(image[..., :3] == COLOURS[j]).all(-1) & (image[..., 3] > 0)] = projected[j, 2]
        np.savez_compressed(root / f"A/depth/A_{k:02d}.npz", depth=depth)
        stored.append(depth)
    scene = read(root).load(0, [2, 0], truth=True)
    np.testing.assert_allclose(scene.depth * item["scale"], np.stack(stored)[[2, 0]], rtol=1e-5)
    assert torch.equal(scene.depth > 0, scene.mask) and read(root).load(0).depth is None
    for change in ({"depth": depth[:32]}, {"depth": depth - 1}, {"depth": depth * np.nan}, {"z": depth}):
        np.savez(root / "A/depth/A_01.npz", **change)
        with pytest.raises(DataError, match=r"depth/A_01\.npz: expected"):
            read(root).load(0, truth=True)
    (root / "A/depth/A_01.npz").unlink()
    with pytest.raises(DataError, match=r"depth/A_01\.npz: expected"):
        read(root).load(0, truth=True)


@pytest.mark.parametrize("parent", ["", "abo-release-renders", "home/author/iccv21/RELEASE"])
def test_objects_are_found_wherever_the_archive_put_them(root, parent):
    write_renders(root / parent)
    assert len(read(root)) == 6


def test_objects_may_be_grouped(root):
    for k, group in enumerate(["chairs", "chairs", "lamps/small", "lamps/large"]):
        write_item(root / group / f"B{k}", seed=k)
    (root / "notes/old").mkdir(parents=True)
    (root / "notes/readme.txt").touch()
    reader = read(root, split_sizes={"train": 1})
    assert reader.scenes == ("B0", "B1", "B2", "B3")
    assert reader.load(3).views[0] == "B3_00"


def test_objects_are_looked_for_once_and_again_when_folders_change(root, monkeypatch):
    write_renders(root / "group", items=4)
    read(root)
    (root / "notes.txt").touch()
    with monkeypatch.context() as patch:
        patch.setattr(item_folders_module, "_search", lambda *_: pytest.fail("searched again"))
        assert len(read(root)) == 2
        assert [len(read(root, split=split)) for split in ("val", "test")] == [1, 1]
    for change in (lambda: write_item(root / "group/new"), lambda: shutil.move(root / "group/new", root / "new")):
        change()
        (root / "split_seed0.json").unlink(missing_ok=True)
        assert "new" in read(root, split_sizes={"train": 1}).scenes
        (root / "split_seed0.json").unlink()
    shutil.rmtree(root / "new")
    assert "new" not in read(root, split_sizes={"train": 1}).scenes


def test_splits_share_out_all_objects(root, caplog):
    caplog.set_level(logging.INFO)
    write_renders(root, items=20, views=2, size=(8, 8))
    splits = [read(root, split=split) for split in ("train", "val", "test")]
    assert [len(reader) for reader in splits] == [17, 1, 2]
    assert sorted(sum((reader.scenes for reader in splits), ())) == [f"B{k:03d}" for k in range(20)]
    assert len({reader.identity for reader in splits}) == 3
    assert "split_seed0.json (drawn from seed 0): 17 train, 1 val, 2 test" in caplog.text
    with pytest.raises(ConfigError, match="'dev' is unknown; choose one of train, val, test"):
        read(root, split="dev")


def test_too_few_objects_for_a_split(root):
    write_item(root / "A")
    assert len(read(root)) == 1
    with pytest.raises(MissingSplit, match="no val split; 1 objects are split into 1 train, 0 val, 0 test"):
        read(root, split="val")


def test_roots_that_are_none(root, tmp_path):
    with pytest.raises(DataError, match=r"data: no such folder; set data\.root to the folder that holds <item>/transf"):
        read(root)
    root.mkdir()
    with pytest.raises(DataError, match=r"data: the folder is empty; looked for <item>/transforms\.json"):
        read(root)
    (root / "chairs/x/y").mkdir(parents=True)
    with pytest.raises(DataError, match=r"data: found only chairs; looked for <item>/transforms\.json"):
        read(root)
    write_item(root / "chairs/A")
    write_item(root / "lamps/A")
    with pytest.raises(DataError, match="there twice, in several folders: A; keep one"):
        read(root)


def test_what_changes_what_is_read_is_in_the_identity(root):
    write_renders(root, items=8)
    write_renders(root.parent / "other/data", items=8)
    changes = [
        {},
        {"near": 3.0},
        {"far": 7.0},
        {"distance": 5.0},
        {"convention": "opengl"},
        {"split_seed": 1},
        {"image_size": 32},
        {"crop": 32},
        {"split": "test"},
    ]
    identities = [read(root, **change).identity for change in changes]
    identities.append(read(root.parent / "other/data").identity)
    assert len(set(identities)) == len(identities)
    assert read(root).identity == identities[0]


def test_the_fingerprint_follows_folders_and_cameras(root):
    write_renders(root, items=3)
    first = read(root, split_sizes={"train": 1}).fingerprint()
    assert read(root, split_sizes={"train": 1}).fingerprint() == first
    os.utime(root / "B001/transforms.json", ns=(1, 1))
    second = read(root, split_sizes={"train": 1}).fingerprint()
    (root / "B002/B002_09.png").touch()
    assert len({first, second, read(root, split_sizes={"train": 1}).fingerprint()}) == 3


def edit(change):
    """Damage that is an edit of the values in transforms.json."""

    def damage(folder: Path) -> None:
        values = json.loads((folder / "transforms.json").read_text())
        change(values)
        (folder / "transforms.json").write_text(json.dumps(values))

    return damage


def frame(**changes):
    return edit(lambda values: values["frames"][2].update(changes))


def camera(**changes):
    return edit(lambda values: values["frames"][2]["camera"].update(changes))


def pose(change):
    def apply(values) -> None:
        matrix = np.array(values["frames"][2]["transform_matrix"])
        values["frames"][2]["transform_matrix"] = change(matrix).tolist()

    return edit(apply)


def file(name: str, change):
    return lambda folder: change(folder / name)


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-30])


def other_size(path: Path) -> None:
    Image.new("RGBA", (32, 32)).save(path)


JSON = r"A/transforms\.json: "
CASES = {
    "truncated image": (file("A_02.png", truncate), r"A/A_02\.png: not a whole image"),
    "no image": (file("A_02.png", lambda f: f.write_text("<html>")), r"A/A_02\.png: an image of an unsupported format"),
    "image of another size": (file("A_02.png", other_size), r"A/A_02\.png: 32x32 pixels.*image_size"),
    "frame without image": (file("A_02.png", Path.unlink), r"A: the frames.*without an image: A_02; .* a frame: none"),
    "image without frame": (file("A_04.png", Path.touch), r"A: the frames.*an image: none; .* a frame: A_04"),
    "renamed image": (file("A_02.png", lambda f: f.rename(f.with_name("A_2.png"))), r"image: A_02; .*frame: A_2;"),
    "no transforms": (file("transforms.json", Path.unlink), JSON + r".*'frames', but it cannot be read"),
    "truncated transforms": (file("transforms.json", truncate), JSON + r".*'frames', but it is not JSON"),
    "binary transforms": (file("transforms.json", lambda f: f.write_bytes(b"\xff\xfe\x80")), JSON),
    "a list": (file("transforms.json", lambda f: f.write_text("[1]")), JSON + "expected an object.*found a list"),
    "nested too deep": (file("transforms.json", lambda f: f.write_text("[" * 200_000)), JSON),
    "no frames": (edit(lambda v: v.pop("frames")), JSON + "expected a key 'frames'"),
    "empty frames": (edit(lambda v: v.update(frames=[])), JSON + "'frames' is empty"),
    "frames as object": (edit(lambda v: v.update(frames={})), JSON + "expected a list as 'frames'"),
    "frame as list": (edit(lambda v: v["frames"].__setitem__(2, [])), JSON + r"frames\[2\]: expected a key"),
    "no file_path": (edit(lambda v: v["frames"][2].pop("file_path")), JSON + r"frames\[2\]: .*'file_path'"),
    "file_path of a folder": (frame(file_path="/x/"), JSON + r"frames\[2\]: file_path '/x/' names no image"),
    "file_path twice": (frame(file_path="A_01"), JSON + r"frames\[2\]: file_path 'A_01' names no image of its own"),
    "file_path a number": (frame(file_path=3), JSON + r"frames\[2\]: expected a str as 'file_path', found 3"),
    "no matrix": (edit(lambda v: v["frames"][2].pop("transform_matrix")), JSON + r"frames\[2\]: .*'transform_matrix'"),
    "3x4 matrix": (pose(lambda m: m[:3]), JSON + r"frames\[2\]: transform_matrix: expected 4x4 numbers"),
    "ragged matrix": (frame(transform_matrix=[[1, 2], [3]]), JSON + r"frames\[2\]: transform_matrix: expected 4x4"),
    "words for a matrix": (frame(transform_matrix=[["x"] * 4] * 4), JSON + r"frames\[2\]: transform_matrix"),
    "null in a matrix": (frame(transform_matrix=[[None] * 4] * 4), JSON + "view A_02: .*NaN"),
    "nan in a matrix": (pose(lambda m: m * [1, 1, 1, np.nan]), JSON + "view A_02: .*NaN"),
    "scaled matrix": (pose(lambda m: m * [2, 2, 2, 1]), JSON + "view A_02: the pose is not rigid"),
    "mirrored matrix": (pose(lambda m: m * [-1, 1, 1, 1]), JSON + "view A_02: the pose mirrors space"),
    "transposed matrix": (pose(lambda m: m.T), JSON + "view A_02: the pose is not rigid"),
    "matrix of another convention": (
        pose(lambda m: m @ FLIP),
        JSON + "the views do not share.*A_02 look the other way",
    ),
    "matrix of another object": (pose(lambda m: m + np.eye(4, k=3) * 50), JSON + "the optical axes of the 4 views"),
    "no camera": (edit(lambda v: v["frames"][2].pop("camera")), JSON + r"frames\[2\]: expected a key 'camera'"),
    "camera null": (frame(camera=None), JSON + r"frames\[2\]: expected an object as 'camera', found None"),
    "no angle": (edit(lambda v: v["frames"][2]["camera"].pop("angle_x")), JSON + r"frames\[2\]: camera: .*'angle_x'"),
    "angle in degrees": (camera(angle_x=40.0), JSON + r"frames\[2\]: camera: angle_x = 40 is no field of view"),
    "angle zero": (camera(angle_x=0), JSON + r"frames\[2\]: camera: angle_x = 0 is no field of view"),
    "angle nan": (camera(angle_x=math.nan), JSON + r"frames\[2\]: camera: expected a finite number as 'angle_x'"),
    "angle huge": (camera(angle_x=10**400), JSON + r"frames\[2\]: camera: expected a finite number as 'angle_x'"),
    "angle in words": (camera(angle_x="wide"), JSON + r"frames\[2\]: camera: expected a number as 'angle_x'"),
    "angle true": (camera(angle_x=True), JSON + r"frames\[2\]: camera: expected a number as 'angle_x'"),
    "shift of pixels": (camera(shift_x=12.0), JSON + r"frames\[2\]: camera: shifts \[12\.0, 0\.0\] put"),
    "odd fit": (camera(sensor_fit="DIAGONAL"), JSON + r"frames\[2\]: camera: sensor_fit 'DIAGONAL' is unknown"),
    "fit of a list": (camera(sensor_fit=[1]), JSON + r"frames\[2\]: camera: sensor_fit \[1\] is unknown"),
}


@pytest.mark.parametrize("name", CASES)
def test_damaged_object(root, name):
    write_item(root / "A", seed=1)
    write_item(root / "B", seed=2)
    damage, message = CASES[name]
    damage(root / "A")
    reader = read(root, split_sizes={"train": 1})
    with pytest.raises(DataError, match=message) as error:
        reader.load(0)
    assert str(root / "A") in str(error.value) and "\n" not in str(error.value)
    assert reader.load(1).id == "B"


def test_optional_camera_keys_and_stray_images(root):
    """What Blender writes beside the images (depth, normals) does not count; a camera may be an angle only."""
    item = write_item(root / "A")
    (root / "A/A_00_depth_0001.png").touch()
    (root / "A/thumbnail.png").touch()
    edit(lambda v: [f.update(camera={"angle_x": f["camera"]["angle_x"]}) for f in v["frames"]])(root / "A")
    edit(lambda v: [f.update(file_path=f"D:\\renders\\A\\A_{k:02d}.png") for k, f in enumerate(v["frames"])])(
        root / "A"
    )
    edit(lambda v: v["frames"].reverse())(root / "A")
    scene = read(root).load(0)
    assert scene.views == ("A_00", "A_01", "A_02", "A_03")
    assert_points_found(scene, item)


@pytest.mark.parametrize(
    "changes", [{"near": 5.0}, {"far": 4.0}, {"convention": "blender"}, {"image_size": 0}, {"crop": [1, 2, 3]}]
)
def test_settings_that_make_no_sense(root, changes):
    write_item(root / "A")
    with pytest.raises(ConfigError):
        read(root, **changes)


def test_the_shipped_config_makes_working_data(root):
    write_renders(root, items=8, views=3)
    with initialize_config_dir(CONF, version_base="1.3"):
        config = compose(
            "train", ["data=abo", f"data.root={root}", f"data.cache_dir={root.parent / 'cache'}", "data.num_workers=0"]
        ).data
    data = instantiate(config)
    assert (data.name, data.source_view, data.batch_size) == ("abo", 0, 32)
    data.setup("fit")
    data.setup("test")
    (batch,) = data.test_dataloader()
    assert batch.source_views[0].endswith("_00") and batch.targets.shape == (1, 2, 3, 128, 128)
    assert (batch.near.item(), batch.far.item()) == (pytest.approx(3.2), pytest.approx(6.7))
    assert batch.source_cameras.c2w.shape == (1, 4, 4)
    assert {path.suffix for path in (root.parent / "cache").glob("abo_renders*")} == {".json"}
