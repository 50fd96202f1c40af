import fcntl
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from hydra import compose, initialize_config_dir
from PIL import Image

from nerfdiff.data.readers.srn import SRNReader
from nerfdiff.poses import srn_spiral
from nerfdiff.utils.errors import ConfigError, DataError
from procedural.generate import make_scenes

CONF = Path(__file__).parents[2] / "conf"


def config(root, *overrides):
    """The real configuration with a small set."""
    small = ["resolution=16", "samples_per_pixel=4", "processes=1", "variant=scalar_rgb", "contact_sheet.scenes=3"]
    small += [
        "splits.train={scenes: 3, views: 2}",
        "splits.val={scenes: 1, views: 3}",
        "splits.test={scenes: 1, views: 2}",
    ]
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return compose("make_scenes", [f"root={root}", *small, *overrides])


def files(root):
    """Contents of all files of a set, without the lock."""
    return {
        str(p.relative_to(root)): p.read_bytes() for p in sorted(root.rglob("*")) if p.is_file() and p.name != ".lock"
    }


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    root = tmp_path_factory.mktemp("made") / "cars"
    return root, make_scenes(config(root))


def test_two_processes_write_the_same_bytes_as_one(made, tmp_path):
    root, _ = made
    make_scenes(config(tmp_path / "again", "processes=2"))
    assert files(tmp_path / "again") == files(root)


def test_layout_is_that_of_srn_with_depth_and_mask_beside_it(made):
    root, result = made
    assert result["rendered"] == 3 * 2 + 3 + 2 and result["kept"] == 0
    scene = root / "cars_train" / "000002"
    assert sorted(str(p.relative_to(scene)) for p in scene.rglob("*") if p.is_file()) == [
        *(f"depth/00000{k}.npz" for k in (0, 1)),
        "intrinsics.txt",
        *(f"{kind}/00000{k}.{end}" for kind, end in (("mask", "png"), ("pose", "txt"), ("rgb", "png")) for k in (0, 1)),
        "scene.json",
    ]
    assert {p.name for p in root.iterdir()} >= {
        "cars_train",
        "cars_val",
        "cars_test",
        "scenes.json",
        "contact_sheet.png",
    }
    assert json.loads((scene / "scene.json").read_text())["category"] == "cars"
    assert Image.open(result["contact_sheet"]).size[0] > 16


def test_the_reader_sees_what_was_rendered(made):
    root, _ = made
    scene = SRNReader(root, "cars", "val", near=0.8, far=1.8).load(0, truth=True)
    assert np.abs(scene.cameras.c2w.numpy() - srn_spiral(1.3, 3)).max() < 1e-6
    assert scene.cameras.K[0, 0, 0].item() == pytest.approx(131.25 / 8)
    assert scene.mask.any() and np.array_equal(scene.mask.numpy(), scene.depth.numpy() > 0)
    # The object's bounding box has diagonal 1, so its surface is nearer than half of that to the origin.
    seen = scene.depth[scene.mask]
    assert seen.min() > 1.3 - 0.5 and seen.max() < 1.3 + 0.5


def test_chairs_train_is_nested_as_in_the_public_archive(tmp_path):
    result = make_scenes(config(tmp_path, "scenes=chairs", "splits.train={scenes: 1, views: 1}"))
    pose = np.loadtxt(tmp_path / "chairs_train" / "chairs_2.0_train" / "000000" / "pose" / "000000.txt").reshape(4, 4)
    assert result["rendered"] == 1 + 3 + 2
    assert (tmp_path / "chairs_test" / "000000").is_dir()
    assert np.linalg.norm(pose[:3, 3]) == pytest.approx(2.0)


def test_a_run_goes_on_where_another_was_stopped(made, tmp_path):
    root = tmp_path / "cars"
    shutil.copytree(made[0], root)
    shutil.rmtree(root / "cars_train" / "000001")
    kept = root / "cars_train" / "000000" / "rgb" / "000000.png"
    before = kept.stat().st_mtime_ns
    (root / ".partial" / "cars_train-000001-1" / "rgb").mkdir(parents=True)
    result = make_scenes(config(root))
    assert (result["rendered"], result["kept"]) == (2, 4)
    assert files(root) == files(made[0])
    assert kept.stat().st_mtime_ns == before
    assert not (root / ".partial").exists()


def test_more_scenes_extend_a_set_and_leave_the_first_ones_alone(made, tmp_path):
    root = tmp_path / "cars"
    shutil.copytree(made[0], root)
    result = make_scenes(config(root, "splits.train.scenes=4", "contact_sheet.enabled=false"))
    assert (result["rendered"], result["kept"], result["contact_sheet"]) == (2, 5, None)
    before, after = files(made[0]), files(root)
    assert before.items() <= after.items()
    assert {k.split("/")[1] for k in after.keys() - before.keys()} == {"000003"}


@pytest.mark.parametrize(
    ("override", "named"),
    [
        ("resolution=32", "resolution: 16 there, 32 asked for"),
        ("samples_per_pixel=9", "samples_per_pixel"),
        ("seed=1", "seed: 0 there, 1 asked for"),
        ("scenes.styles.van=5", "styles"),
        ("scenes=chairs", "category"),
        ("splits.train.views=3", "splits.train.views: 2 there, 3 asked for"),
    ],
)
def test_other_parameters_are_refused_and_nothing_changes(made, override, named):
    root, _ = made
    before = files(root)
    with pytest.raises(ConfigError, match=named):
        make_scenes(config(root, override))
    assert files(root) == before


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("+scenes.styles.tank=1", "tank.*sedan"),
        ("scenes.styles.van=-1", "at least 0"),
        ("scenes.category=boats", "cars, chairs"),
        ("+splits.extra={scenes: 1, views: 1}", "train, val, test"),
        ("splits.val.views=252", "251 views"),
        ("splits.train=5", "splits.train"),
        ("resolution=0", "resolution=0"),
        ("processes=-1", "processes=-1"),
        ("scenes.radius=0.4", "outside the object"),
        ("seed=-1", "seed=-1"),
        ("variant=opengl", "scalar_rgb"),
    ],
)
def test_impossible_values_are_refused_before_anything_is_written(tmp_path, override, message):
    with pytest.raises(ConfigError, match=message):
        make_scenes(config(tmp_path / "none", override))
    assert not (tmp_path / "none").exists()


def test_a_broken_manifest_a_busy_root_and_a_file_in_its_place_are_named(tmp_path):
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken" / "scenes.json").write_text("{")
    with pytest.raises(DataError, match=r"scenes\.json"):
        make_scenes(config(tmp_path / "broken"))
    (tmp_path / "file").write_text("")
    with pytest.raises(DataError, match="file"):
        make_scenes(config(tmp_path / "file"))
    (tmp_path / "busy").mkdir()
    with (tmp_path / "busy" / ".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        with pytest.raises(DataError, match="another run"):
            make_scenes(config(tmp_path / "busy"))


def test_a_scene_that_cannot_be_written_leaves_no_half_of_it(tmp_path):
    (tmp_path / "cars_train").write_text("a file where the split's folder belongs")
    with pytest.raises(DataError, match="cars_train"):
        make_scenes(config(tmp_path))
    assert not (tmp_path / ".partial").exists()


def test_splits_hold_different_objects_and_every_scene_its_own(made):
    root, _ = made
    first = [root / split / "000000" / "rgb" / "000000.png" for split in ("cars_train", "cars_val", "cars_test")]
    first += [root / "cars_train" / f"00000{k}" / "rgb" / "000000.png" for k in (1, 2)]
    assert len({path.read_bytes() for path in first}) == 5
