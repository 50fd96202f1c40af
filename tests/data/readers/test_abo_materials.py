"""The 91-view reader on layouts whose every pixel is known, and on damaged ones."""

import json
import logging
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate
from PIL import Image
from torch.utils.data import DataLoader

from abo_fixtures import (
    COLOURS,
    DISTANCE,
    POINTS,
    draw,
    project,
    visible,
    write_exr,
    write_material_item,
    write_materials,
)
from nerfdiff.data.readers import item_folders as item_folders_module
from nerfdiff.data.readers.abo_material_files import read_split
from nerfdiff.data.readers.abo_materials import ABOMaterials
from nerfdiff.data.scene import MissingSplit, SceneReader
from nerfdiff.utils.errors import ConfigError, DataError

CONF = str(Path(__file__).parents[3] / "conf")
SETTINGS = {
    "split": "train",
    "near": 2.45,
    "far": 7.45,
    "distance": DISTANCE,
    "convention": "auto",
    "environment": "first",
    "depth_kind": "z",
    "missing_items": "error",
    "val_fraction": 0.0,
    "split_seed": 0,
}


@pytest.fixture
def root(tmp_path):
    return tmp_path / "data"


def read(root, **changes) -> ABOMaterials:
    return ABOMaterials(root, index_dir=root.parent / "cache", **SETTINGS | changes)


def test_known_points_are_found(root):
    items = write_materials(root, train=3)
    reader = read(root)
    assert isinstance(reader, SceneReader) and reader.scenes == ("B000", "B001", "B002")
    checked = 0
    for index in range(3):
        scene, item = reader.load(index, truth=True), items[reader.scene_id(index)]
        # in the order of the numbers: 2 before 10
        assert scene.views == reader.view_names(index) == tuple(f"render_{k}" for k in range(12))
        assert (scene.near, scene.far) == (2.45, 7.45)
        pixels, depth = scene.cameras.project(torch.from_numpy(POINTS).float())
        for v, pose in enumerate(item["poses"]):
            expected = project(pose, item["camera"], 64, 64, item["points"])
            np.testing.assert_allclose(pixels[v], expected[:, :2], atol=1e-3)
            np.testing.assert_allclose(depth[v], expected[:, 2] / item["scale"], rtol=1e-5)
            image = draw(expected, 64, 64)
            assert np.array_equal(scene.mask[v], image[..., 3] > 0)
            assert (scene.pixels[v][:, ~scene.mask[v]] == 255).all() and not scene.depth[v][~scene.mask[v]].any()
            for k in visible(expected, 64, 64):
                column, row = pixels[v, k].floor().long()
                difference = scene.pixels[v, :, row, column].int() - torch.from_numpy(COLOURS[k]).int()
                assert difference.abs().max() <= 3  # JPEG
                assert scene.depth[v, row, column].item() == pytest.approx(depth[v, k].item(), rel=1e-3)  # half floats
                checked += 1
    assert checked > 100


def test_the_releases_intrinsics(root):
    write_material_item(root / "B", views=2, size=512, environments=("0",))
    (root / "train_test_split.csv").write_text("MODEL,SPLIT\nB,TRAIN\n")
    K = read(root).load(0, [0]).cameras.K[0]
    torch.testing.assert_close(K, torch.tensor([[443.40496826, 0, 256], [0, 443.40496826, 256], [0, 0, 1]]))
    K = read(root, image_size=128).load(0, [0]).cameras.K[0]
    torch.testing.assert_close(K, torch.tensor([[110.851242, 0, 64], [0, 110.851242, 64], [0, 0, 1]]))


def test_depth_reprojects_between_views_and_tells_its_kind(root):
    """Depth along rays, read as such, is depth along the axis."""
    items = write_materials(root, train=1, test=0, half=False)
    item = items["B000"]
    z = read(root).load(0, truth=True)
    for k, pose in enumerate(item["poses"]):
        expected = project(pose, item["camera"], 64, 64, item["points"])
        image, stored = draw(expected, 64, 64), np.full((64, 64), 65504.0)
        for j in np.argsort(-expected[:, 2]):
            stored[(image[..., :3] == COLOURS[j]).all(-1) & (image[..., 3] > 0)] = expected[j, 2]
        for v, u in zip(*np.nonzero(stored < 65000), strict=True):  # the length of the ray, one pixel at a time
            x, y = (np.array([u, v]) + 0.5 - 32) / (443.40496826 / 8)
            stored[v, u] *= np.linalg.norm([x, y, 1])
        write_exr(root / f"B000/depth/depth_{k}.exr", stored)
    assert not torch.allclose(read(root).load(0, truth=True).depth, z.depth)
    torch.testing.assert_close(read(root, depth_kind="ray").load(0, truth=True).depth, z.depth)
    # a point of one view, moved through space into the others, is where their cameras see it
    rays = z.cameras.rays(1.0, 2.0)
    seen = visible(project(item["poses"][0], item["camera"], 64, 64, item["points"]), 64, 64)
    assert seen
    for k in seen:
        pixels, _ = z.cameras.project(torch.from_numpy(POINTS[k : k + 1]).float())
        column, row = pixels[0, 0].floor().long()
        along = z.depth[0, row, column] / (rays.directions[0, row, column] @ z.cameras.c2w[0, :3, 2])
        point = rays.origins[0, row, column] + along * rays.directions[0, row, column]
        moved, _ = z.cameras.project(point[None])
        assert (moved - pixels).abs().max() < 1.5  # the pixel's centre is not the point


def test_crop_and_size_frame_everything_alike(root):
    item = write_materials(root, train=1, test=0)["B000"]
    scene = read(root, crop=48, image_size=24).load(0, [5], truth=True)
    assert scene.pixels.shape == (1, 3, 24, 24) and scene.mask.shape == scene.depth.shape == (1, 24, 24)
    expected = project(item["poses"][5], item["camera"], 64, 64, item["points"])
    pixels, depth = scene.cameras.project(torch.from_numpy(POINTS).float())
    np.testing.assert_allclose(pixels[0], (expected[:, :2] - 8) / 2, atol=1e-3)
    seen = visible(expected, 64, 64)
    assert seen
    for k in seen:
        column, row = pixels[0, k].floor().long()
        assert scene.mask[0, row, column]
        assert scene.depth[0, row, column].item() == pytest.approx(depth[0, k].item(), rel=1e-3)


def test_environments_of_light(root):
    items = write_materials(root, train=2, test=0)
    for e in ("0", "1"):  # not every object has all three
        for path in (root / "B001/render" / e).iterdir():
            path.unlink()
        (root / "B001/render" / e).rmdir()
    for path in [*(root / "B000/segmentation").iterdir()]:  # a mask over everything shows which light it is
        Image.new("L", (64, 64), 255).save(path)

    def grey(scene) -> int:
        """Grey of the pixel that is nowhere near a point."""
        projected = project(items["B000"]["poses"][0], items["B000"]["camera"], 64, 64, items["B000"]["points"])
        assert draw(projected, 64, 64)[0, 0, 3] == 0
        return scene.pixels[0, 0, 0, 0].item()

    assert grey(read(root).load(0)) == 90
    assert grey(read(root, environment=1).load(0)) == 110 and grey(read(root, environment="2").load(0)) == 130
    reader = read(root, environment="all")
    assert reader.scenes == ("B000_0", "B000_1", "B000_2", "B001_2")
    assert [grey(reader.load(index)) for index in range(3)] == [90, 110, 130]
    assert read(root).load(1).id == "B001"
    with pytest.raises(DataError, match=r"B001/render/1: no such folder"):
        read(root, environment=1).load(1)
    (root / "B001/render/7").mkdir()
    assert read(root, environment="all").scenes[3:] == ("B001_2", "B001_7")


@pytest.mark.parametrize("parent", ["", "abo-benchmark-material", "some folder"])
@pytest.mark.parametrize("folder", ["", "all_objects"])
def test_folders_are_probed(root, parent, folder):
    write_materials(root / parent, train=2, test=1, folder=folder, views=2)
    assert read(root).scenes == ("B000", "B001") and read(root, split="test").scenes == ("B002",)


@pytest.mark.parametrize(
    "text",
    [
        "MODEL,SPLIT,N_SCENES,SCENES\na,TRAIN,3,0_1_2\nb,TEST,1,2\nc,TRAIN,2,0_1\n",
        "item,split\na,train\nb,test\nc,train\n",
        "split,item_id\ntrain,a\ntest,b\n\ntrain,c\n",
        "a,train\nb,test\nc,train\n",
        "number,split,model\n1,Train,a\n2,Test,b\n3,Train,c\r\n",
        '"item","split"\n"a", "train"\n"b","test"\n"c","train"\n"a","train"\n',
    ],
)
def test_tables_of_the_split(tmp_path, text):
    (tmp_path / "t.csv").write_text(text)
    assert read_split(tmp_path / "t.csv") == {"train": ["a", "c"], "val": [], "test": ["b"]}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "found rows of no cells"),
        ("item,split\n", r"found rows|found no object|each object in one"),
        ("a\nb\n", "found rows of 1 cells"),
        ("item,split\na,train\nb\n", "found rows of 1 and 2 cells"),
        ("item,split\na,train\nb,dev\n", r"found 'b,dev'"),
        ("item,split\na,train\na,test\n", r"found 'a,test'"),
        ("item,split\na,train\n,test\n", r"found ',test'"),
        ("item,colour\na,red\n", "each object in one of train, val, test"),
    ],
)
def test_tables_that_are_none(tmp_path, text, message):
    (tmp_path / "t.csv").write_text(text)
    with pytest.raises(DataError, match=rf"t\.csv: expected a table.*{message}"):
        read_split(tmp_path / "t.csv")


def test_val_is_taken_from_train_by_seed(root):
    write_materials(root, train=8, test=2, views=2, size=16, environments=("0",))
    splits = {split: read(root, split=split, val_fraction=0.25).scenes for split in ("train", "val", "test")}
    assert [len(members) for members in splits.values()] == [6, 2, 2]
    assert sorted(splits["train"] + splits["val"]) == [f"B{k:03d}" for k in range(8)]
    again = [read(root, split="val", val_fraction=0.25, split_seed=seed).scenes for seed in range(5)]
    assert again[0] == splits["val"] and len(set(again)) > 1
    with pytest.raises(MissingSplit, match=r"no val split; train_test_split\.csv has 8 train, 0 val, 2 test"):
        read(root, split="val")
    table = root / "train_test_split.csv"
    table.write_text(table.read_text().replace("B003,TRAIN", "B003,VAL"))
    assert read(root, split="val", val_fraction=0.25).scenes == ("B003",)


def test_objects_without_a_folder(root, caplog):
    write_materials(root, train=3, test=1, views=2)
    (root / "B001/metadata.json").unlink()
    with pytest.raises(DataError, match=r"csv: 1 of its objects have no folder with metadata\.json: B001; .*=skip"):
        read(root)
    assert read(root, missing_items="skip").scenes == ("B000", "B002")
    assert "going on without 1 objects that have no folder: B001" in caplog.text
    shutil.rmtree(root / "B003")
    with pytest.raises(DataError, match="none of its 1 objects has a folder"):
        read(root, split="test", missing_items="skip")


def test_roots_that_are_none(root):
    with pytest.raises(DataError, match=r"data: no such folder; set data\.root"):
        read(root)
    root.mkdir()
    with pytest.raises(DataError, match=r"data: the folder is empty; looked for train_test_split\.csv"):
        read(root)
    write_material_item(root / "B", views=2)
    with pytest.raises(DataError, match=r"data: found only B; looked for train_test_split\.csv"):
        read(root)


def test_objects_are_looked_for_once(root, monkeypatch):
    write_materials(root, train=3, test=1, views=2)
    read(root)
    monkeypatch.setattr(item_folders_module, "_search", lambda *_: pytest.fail("searched again"))
    assert len(read(root)) == 3 and len(read(root, split="test")) == 1


def test_what_changes_what_is_read_is_in_the_identity(root):
    write_materials(root, train=3, test=1, views=2)
    changes = [
        {},
        {"near": 3.0},
        {"far": 7.0},
        {"distance": 5.0},
        {"convention": "opengl"},
        {"environment": 0},
        {"environment": "all"},
        {"depth_kind": "ray"},
        {"image_size": 32},
        {"crop": 32},
        {"split": "test"},
        {"val_fraction": 0.3},
        {"val_fraction": 0.3, "split_seed": 1},
    ]
    assert len({read(root, **change).identity for change in changes}) == len(changes)


def test_the_fingerprint_follows_the_environment_that_is_read(root):
    write_materials(root, train=1, test=0, views=2)
    prints = [read(root).fingerprint(), read(root, environment=1).fingerprint()]
    assert read(root).fingerprint() == prints[0]
    (root / "B000/render/1/render_9.jpg").touch()
    prints.append(read(root, environment=1).fingerprint())
    (root / "B000/segmentation/segmentation_9.jpg").touch()
    prints += [read(root).fingerprint(), read(root, environment=1).fingerprint()]
    assert len(set(prints)) == 5


def test_workers_read_depth_after_their_parent_did(root):
    """Forked workers inherit no threads, which is where readers of EXR hang."""
    write_materials(root, train=4, test=0, views=3)
    reader = read(root)
    alone = [reader.load(index, truth=True).depth for index in range(4)]
    loader = DataLoader(range(4), batch_size=None, num_workers=1, collate_fn=_Depth(reader), timeout=60)
    for here, there in zip(alone, loader, strict=True):
        assert torch.equal(here, there)


class _Depth:
    def __init__(self, reader: ABOMaterials):
        self.reader = reader

    def __call__(self, index: int) -> torch.Tensor:
        return self.reader.load(int(index), truth=True).depth


def edit(change):
    """Damage that is an edit of the values in metadata.json; `change` gets them sorted by number."""

    def damage(folder: Path) -> None:
        values = json.loads((folder / "metadata.json").read_text())
        values["views"].sort(key=lambda view: view["index"])
        change(values)
        (folder / "metadata.json").write_text(json.dumps(values))

    return damage


def view(key: str, value):
    return edit(lambda values: values["views"][2].update({key: value}))


def pose(change):
    def apply(values) -> None:
        matrix = np.array(values["views"][2]["pose"]).reshape(4, 4)
        values["views"][2]["pose"] = change(matrix).ravel().tolist()

    return edit(apply)


def file(name: str, change):
    return lambda folder: change(folder / name)


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def exr(value: float):
    def write(path: Path) -> None:
        write_exr(path, np.full((64, 64), value))

    return write


JSON = r"B000/metadata\.json: "
CASES = {
    "truncated image": (file("render/0/render_2.jpg", truncate), r"render/0/render_2\.jpg: not a whole image"),
    "truncated mask": (file("segmentation/segmentation_2.jpg", truncate), r"segmentation_2\.jpg: not a whole image"),
    "truncated depth": (file("depth/depth_2.exr", truncate), r"depth/depth_2\.exr: not a whole EXR image"),
    "depth of text": (file("depth/depth_2.exr", lambda f: f.write_text("<html>")), r"depth_2\.exr: not a whole EXR"),
    "depth of nan": (file("depth/depth_2.exr", exr(np.nan)), r"depth_2\.exr: expected depths of at least 0"),
    "depth below zero": (file("depth/depth_2.exr", exr(-1.0)), r"depth_2\.exr: expected depths of at least 0"),
    "depth of another size": (
        file("depth/depth_2.exr", lambda f: write_exr(f, np.ones((32, 48)))),
        r"depth_2\.exr: 32x48 values, but the image has 64x64",
    ),
    "mask of another size": (
        file("segmentation/segmentation_2.jpg", lambda f: Image.new("L", (32, 32)).save(f)),
        r"segmentation_2\.jpg: 32x32 pixels, but .*render_2\.jpg has 64x64",
    ),
    "missing image": (file("render/0/render_2.jpg", Path.unlink), r"B000/render/0: 3 files.*without a file: 2;"),
    "missing mask": (file("segmentation/segmentation_2.jpg", Path.unlink), r"B000/segmentation: 3 files.*a file: 2;"),
    "missing depth": (file("depth/depth_2.exr", Path.unlink), r"B000/depth: 3 files.*without a file: 2;"),
    "image without view": (file("render/0/render_9.jpg", Path.touch), r"render/0: 5 files.*without a view: 9$"),
    "no masks": (file("segmentation", lambda f: f.rename(f.parent / "seg")), r"B000/segmentation: no such folder"),
    "no renders": (file("render", lambda f: f.rename(f.parent / "r")), r"B000/render: no environment in it"),
    "truncated metadata": (file("metadata.json", truncate), JSON + ".*not JSON"),
    "a list": (file("metadata.json", lambda f: f.write_text("[]")), JSON + ".*found a list"),
    "no views": (edit(lambda v: v.pop("views")), JSON + "expected a key 'views'"),
    "empty views": (edit(lambda v: v.update(views=[])), JSON + "'views' is empty"),
    "view of a number": (edit(lambda v: v["views"].__setitem__(2, 5)), JSON + r"views\[2\]: expected a key 'index'"),
    "index twice": (view("index", 1), JSON + r"views\[2\]: index 1 is there twice"),
    "index in words": (view("index", "2"), JSON + r"views\[2\]: expected a whole number as 'index', found '2'"),
    "short pose": (view("pose", [1.0] * 12), JSON + r"views\[2\]: pose: expected 4x4 numbers"),
    "no pose": (edit(lambda v: v["views"][2].pop("pose")), JSON + r"views\[2\]: expected a key 'pose'"),
    "nan in pose": (pose(lambda m: m * [1, 1, 1, np.nan]), JSON + "view 2: .*NaN"),
    "scaled pose": (pose(lambda m: m * [2, 2, 2, 1]), JSON + "view 2: the pose is not rigid"),
    "pose of another object": (pose(lambda m: m + np.eye(4, k=3) * 50), JSON + "the optical axes of the 4 views"),
    "short K": (view("K", [1.0] * 8), JSON + r"views\[2\]: K: expected 3x3 numbers"),
    "negative K": (view("K", [-55.0, 0, 32, 0, 55, 32, 0, 0, 1]), JSON + r"view 2: .* is no K of a 64x64 image"),
    "nan in K": (view("K", [float("nan"), 0, 32, 0, 55, 32, 0, 0, 1]), JSON + "view 2: .* is no K"),
    "K of other pixels": (view("K", [443.4, 0, 256, 0, 443.4, 256, 0, 0, 1]), JSON + "view 2: .* is no K of a 64x64"),
    "skewed K": (view("K", [55.0, 3, 32, 0, 55, 32, 0, 0, 1]), JSON + "view 2: .* is no K"),
}


@pytest.mark.parametrize("name", CASES)
def test_damaged_object(root, name):
    write_materials(root, train=2, test=0, views=4)
    damage, message = CASES[name]
    damage(root / "B000")
    reader = read(root)
    with pytest.raises(DataError, match=message) as error:
        reader.load(0, truth=True)
    assert str(root / "B000") in str(error.value) and "\n" not in str(error.value)
    assert reader.load(1, truth=True).id == "B001"


def test_objects_without_depth_have_none(root):
    write_materials(root, train=1, test=0, views=2)
    (root / "B000/depth").rename(root / "B000/elsewhere")
    scene = read(root).load(0, truth=True)
    assert scene.depth is None and scene.mask is not None


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"split": "dev"}, "split 'dev' is unknown; choose one of train, val, test"),
        ({"depth_kind": "metres"}, "depth_kind 'metres' is unknown; choose one of z, ray"),
        ({"missing_items": "ignore"}, "missing_items 'ignore'"),
        ({"val_fraction": 1.0}, "val_fraction = 1"),
        ({"near": 5.0}, "0 < near < distance < far"),
        ({"convention": "blender"}, "convention 'blender'"),
        ({"image_size": 0}, "image_size"),
    ],
)
def test_settings_that_make_no_sense(root, changes, message):
    write_materials(root, train=1, test=1, views=2)
    with pytest.raises(ConfigError, match=message):
        read(root, **changes)


def test_conventions(root, caplog):
    caplog.set_level(logging.INFO)
    write_materials(root, train=3, test=0, views=4)
    reader = read(root)
    for index in range(3):
        reader.load(index)
    geometry = reader.geometry(0)
    assert (geometry.convention, geometry.inverted) == ("opengl", False)
    assert len([record for record in caplog.records if "OpenGL/Blender axes" in record.message]) == 1
    with pytest.raises(DataError, match="convention=opencv, but"):
        read(root, convention="opencv").load(0)


def test_the_shipped_config_makes_working_data(root):
    write_materials(root, train=3, test=1, views=3)
    overrides = [
        "data=abo_materials",
        f"data.root={root}",
        f"data.cache_dir={root.parent / 'cache'}",
        "data.num_workers=0",
    ]
    with initialize_config_dir(CONF, version_base="1.3"):
        data = instantiate(compose("train", overrides).data)
    data.setup("fit")
    data.setup("test")
    (batch,) = data.test_dataloader()
    assert batch.source_views == ("render_0",) and batch.targets.shape == (1, 2, 3, 128, 128)
    assert (batch.near.item(), batch.far.item()) == (pytest.approx(2.45), pytest.approx(7.45))
