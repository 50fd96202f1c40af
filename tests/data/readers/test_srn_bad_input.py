"""What is wrong on disk gives one error of one line that names the file."""

import numpy as np
import pytest
from PIL import Image

from data_fixtures import FAR, HEIGHT, NEAR, WIDTH, write_srn
from nerfdiff.data.readers.srn import SRNReader
from nerfdiff.utils.errors import ConfigError, DataError


def damage(root, name: str, change) -> None:
    file = root / "cars_train/scene0" / name
    change(file)


def replace_with(text: str):
    return lambda file: file.write_text(text)


def pose_text(**changes) -> str:
    pose = np.eye(4)
    for entry, value in changes.items():
        pose[int(entry[1]), int(entry[2])] = value
    return " ".join(map(str, pose.ravel()))


def truncate(file) -> None:
    file.write_bytes(file.read_bytes()[:-60])


def other_size(file) -> None:
    Image.fromarray(np.zeros((HEIGHT * 2, WIDTH * 2, 3), np.uint8)).save(file)


CASES = {
    "truncated image": ("rgb/000002.png", truncate, r"rgb/000002\.png: not a whole image"),
    "no image": ("rgb/000002.png", replace_with("<html>"), r"rgb/000002\.png: an image of an unsupported format"),
    "image of another size": ("rgb/000002.png", other_size, r"rgb/000002\.png: 80x112 pixels.*image_size"),
    "image without pose": ("pose/000003.txt", lambda f: f.unlink(), r"images without a pose: 000003;"),
    "pose without image": ("rgb/000001.png", lambda f: f.unlink(), r"poses without an image: 000001$"),
    "renamed pose": (
        "pose/000003.txt",
        lambda f: f.rename(f.with_name("3.txt")),
        r"scene0: 5 images in rgb/ and 5 poses.*pose: 000003;.*image: 3$",
    ),
    "pose with nan": ("pose/000004.txt", replace_with(pose_text(p12=np.nan)), r"pose/000004\.txt.*NaN"),
    "scaled pose": ("pose/000004.txt", replace_with(pose_text(p00=2, p11=2, p22=2)), r"pose/000004\.txt.*not rigid"),
    "sheared pose": ("pose/000004.txt", replace_with(pose_text(p01=0.1)), r"pose/000004\.txt.*not rigid"),
    "mirrored pose": ("pose/000004.txt", replace_with(pose_text(p00=-1)), r"pose/000004\.txt.*mirrors"),
    "transposed pose": ("pose/000004.txt", replace_with(pose_text(p31=1.3)), r"pose/000004\.txt.*last row"),
    "short pose": ("pose/000004.txt", replace_with("1 0 0 0"), r"pose/000004\.txt.*16 finite numbers, found 4"),
    "words for a pose": ("pose/000004.txt", replace_with("a " * 16), r"pose/000004\.txt.*16 finite numbers"),
    "binary pose": ("pose/000004.txt", lambda f: f.write_bytes(b"\xff\xfe\x80" * 9), r"pose/000004\.txt"),
    "no intrinsics": ("intrinsics.txt", lambda f: f.unlink(), r"intrinsics\.txt: expected"),
    "short intrinsics": ("intrinsics.txt", replace_with("50 28 20 0\n0 0 0\n1\n"), r"intrinsics\.txt: expected"),
    "intrinsics in words": ("intrinsics.txt", replace_with("f cx cy 0\n0 0 0\n1\n40 56"), r"intrinsics\.txt: expected"),
    "negative focal length": (
        "intrinsics.txt",
        replace_with("-5 28 20 0\n0 0 0\n1\n40 56"),
        r"intrinsics\.txt: f = -5",
    ),
    "nan focal length": ("intrinsics.txt", replace_with("nan 28 20 0\n0 0 0\n1\n40 56"), r"intrinsics\.txt: f = nan"),
    "centre outside": ("intrinsics.txt", replace_with("50 28 64 0\n0 0 0\n1\n40 56"), r"intrinsics\.txt.*\(28, 64\)"),
    "size zero": ("intrinsics.txt", replace_with("50 28 20 0\n0 0 0\n1\n0 0"), r"intrinsics\.txt.*0x0"),
    "height and width swapped": (
        "intrinsics.txt",
        replace_with("50 20 28 0\n0 0 0\n1\n56 40"),
        r"intrinsics\.txt.*56x40.*40x56",
    ),
    "odd flag": ("intrinsics.txt", replace_with("50 28 20 0\n0 0 0\n1\n40 56\nyes"), r"intrinsics\.txt: expected"),
}


@pytest.mark.parametrize("name", CASES)
def test_damaged_scene(tmp_path, name):
    write_srn(tmp_path)
    file, change, message = CASES[name]
    damage(tmp_path, file, change)
    with pytest.raises(DataError, match=message) as error:
        SRNReader(tmp_path, "cars", "train", NEAR, FAR).load(0)
    assert str(tmp_path / "cars_train" / "scene0") in str(error.value)
    assert "\n" not in str(error.value)
    SRNReader(tmp_path, "cars", "train", NEAR, FAR).load(1)


@pytest.mark.parametrize(
    "text",
    ["50 0 27 0 50 21 0 0", "50 0 270 0 50 21 0 0 1", "-50 0 27 0 50 21 0 0 1", "50 3 27 0 50 21 0 0 1"],
    ids=["short", "centre outside", "negative", "skewed"],
)
def test_wrong_intrinsics_of_a_view(tmp_path, text):
    write_srn(tmp_path)
    folder = tmp_path / "cars_train/scene0"
    (folder / "intrinsics.txt").unlink()
    (folder / "intrinsics").mkdir()
    for k in range(5):
        (folder / f"intrinsics/{k:06d}.txt").write_text("50 0 27 0 50 21 0 0 1" if k != 3 else text)
    reader = SRNReader(tmp_path, "cars", "train", NEAR, FAR)
    assert len(reader.load(0, [0, 1]).views) == 2
    with pytest.raises(DataError, match=r"intrinsics/000003\.txt"):
        reader.load(0)


def test_folders_that_are_not_there(tmp_path):
    with pytest.raises(DataError, match=r"nowhere: no such folder.*data\.root.*cars_train"):
        SRNReader(tmp_path / "nowhere", "cars", "train", NEAR, FAR)
    with pytest.raises(DataError, match=r"is empty; expected one of cars_train, srn_cars/cars_train"):
        SRNReader(tmp_path, "cars", "train", NEAR, FAR)
    (tmp_path / "cars_train").mkdir()
    with pytest.raises(DataError, match="cars_train: the train split is empty"):
        SRNReader(tmp_path, "cars", "train", NEAR, FAR)
    (tmp_path / "cars_train/scene0").mkdir()
    with pytest.raises(DataError, match="scene0/rgb: no such folder"):
        SRNReader(tmp_path, "cars", "train", NEAR, FAR).load(0)
    (tmp_path / "cars_train/scene0/rgb").mkdir()
    with pytest.raises(DataError, match=r"scene0/rgb: no \.png"):
        SRNReader(tmp_path, "cars", "train", NEAR, FAR).load(0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"category": "planes"}, "'planes' is unknown; choose one of cars, chairs"),
        ({"split": "dev"}, "'dev' is unknown; choose one of train, val, test"),
        ({"near": 2.0}, "0 < near < far"),
        ({"image_size": [64]}, "image_size"),
        ({"image_size": 0}, "image_size"),
    ],
)
def test_settings_that_make_no_sense(tmp_path, changes, message):
    write_srn(tmp_path)
    settings = {"category": "cars", "split": "train", "near": NEAR, "far": FAR, **changes}
    with pytest.raises(ConfigError, match=message):
        SRNReader(tmp_path, **settings)


def test_one_view_under_two_suffixes(tmp_path):
    write_srn(tmp_path)
    (tmp_path / "cars_train/scene0/rgb/000000.jpg").touch()
    with pytest.raises(DataError, match="scene0/rgb: 1 views are there twice"):
        SRNReader(tmp_path, "cars", "train", NEAR, FAR).load(0)
