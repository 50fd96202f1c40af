"""What may stand in a transforms.json, and what may not."""

import json
import math

import numpy as np
import pytest

from nerfdiff.data.formats.transforms_json import find_image, is_scene, read_transforms
from nerfdiff.utils.errors import DataError
from posed_fixtures import CX, CY, FX, FY, HEIGHT, WIDTH, cameras, write_blender, write_nerfstudio

GL_TO_CV = np.diag([1.0, -1, -1, 1])


def edit(folder, change, name: str = "transforms.json") -> None:
    """Change the file's content in place."""
    content = json.loads((folder / name).read_text())
    change(content)
    (folder / name).write_text(json.dumps(content))


def frame_edit(index: int, **values):
    """Values of None remove the key."""

    def change(content):
        for key, value in values.items():
            content["frames"][index].pop(key, None)
            if value is not None:
                content["frames"][index][key] = value

    return change


def top_edit(**values):
    def change(content):
        for key, value in values.items():
            content.pop(key, None)
            if value is not None:
                content[key] = value

    return change


def test_nerfstudio(tmp_path):
    poses = write_nerfstudio(tmp_path, near=0.5, far=9)
    found = read_transforms(tmp_path)
    assert (found.near, found.far) == (0.5, 9) and is_scene(tmp_path)
    assert [frame.name for frame in found.frames] == [f"frame_{k + 1:05d}" for k in range(6)]
    np.testing.assert_allclose(found.c2w, poses @ GL_TO_CV)
    assert found.frames[2].image == tmp_path / "images/frame_00003.png"
    assert found.frames[2].mask == tmp_path / "masks/frame_00003.png"
    assert np.array_equal(found.frames[2].pinhole.K(HEIGHT, WIDTH), [[FX, 0, CX], [0, FY, CY], [0, 0, 1]])
    assert np.array_equal(
        found.frames[2].pinhole.K(HEIGHT * 2, WIDTH * 2), [[FX * 2, 0, CX * 2], [0, FY * 2, CY * 2], [0, 0, 1]]
    )


def test_blender_synthetic(tmp_path):
    poses = write_blender(tmp_path)
    found = read_transforms(tmp_path)
    names = [frame.name for frame in found.frames]
    assert names == sorted(poses) and names[0] == "test_r_0"
    np.testing.assert_allclose(found.c2w, np.stack([poses[name] for name in names]) @ GL_TO_CV)
    assert find_image(found.frames[0].image) == tmp_path / "test/r_0.png" and found.frames[0].mask is None
    np.testing.assert_allclose(
        found.frames[0].pinhole.K(HEIGHT, WIDTH), [[FX, 0, WIDTH / 2], [0, FX, HEIGHT / 2], [0, 0, 1]]
    )


def test_opencv_poses_are_left_as_they_are(tmp_path):
    poses = write_nerfstudio(tmp_path)
    np.testing.assert_allclose(read_transforms(tmp_path, "opencv").c2w, poses)


def test_one_file_comes_before_the_others(tmp_path):
    write_blender(tmp_path)
    write_nerfstudio(tmp_path, views=3)
    assert len(read_transforms(tmp_path).frames) == 3


def test_views_are_in_natural_order(tmp_path):
    write_nerfstudio(tmp_path)

    def rename(content):
        for k, frame in enumerate(content["frames"]):
            frame["file_path"] = f"images/r_{[10, 2, 1, 33, 3, 100][k]}.png"

    edit(tmp_path, rename)
    assert [f.name for f in read_transforms(tmp_path).frames] == ["r_1", "r_2", "r_3", "r_10", "r_33", "r_100"]


def test_names_that_occur_twice_are_told_apart_by_their_folders(tmp_path):
    write_nerfstudio(tmp_path, views=2)
    edit(tmp_path, frame_edit(1, file_path="./images_b\\frame_00001.png"))
    found = read_transforms(tmp_path).frames
    assert [frame.name for frame in found] == ["images_b_frame_00001", "images_frame_00001"]
    assert found[0].image == tmp_path / "images_b/frame_00001.png"


def test_intrinsics_of_a_frame_come_before_those_of_the_file(tmp_path):
    write_nerfstudio(tmp_path)
    edit(tmp_path, frame_edit(1, fl_x=70.0, fl_y=71.0))
    frames = read_transforms(tmp_path).frames
    assert frames[0].pinhole.K(HEIGHT, WIDTH)[0, 0] == FX
    assert frames[1].pinhole.K(HEIGHT, WIDTH).tolist() == [[70, 0, CX], [0, 71, CY], [0, 0, 1]]


def test_distortion_of_a_frame_comes_before_that_of_the_file(tmp_path):
    write_nerfstudio(tmp_path)
    assert all(frame.lens is None for frame in read_transforms(tmp_path).frames)
    edit(tmp_path, top_edit(k1=0.1, k3=0.3, p2=0.6))
    edit(tmp_path, frame_edit(1, k1=-0.2, k4=0.4, p1=0.5))
    edit(tmp_path, frame_edit(2, k1=0, k3=0, p2=0))
    frames = read_transforms(tmp_path).frames
    assert (frames[0].lens.radial, frames[0].lens.tangential) == ((0.1, 0, 0.3, 0), (0, 0.6))
    assert (frames[1].lens.radial, frames[1].lens.tangential) == ((-0.2, 0, 0.3, 0.4), (0.5, 0.6))
    assert frames[2].lens is None


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"fl_y": None}, [FX, FX, CX, CY]),
        ({"cx": None, "cy": None}, [FX, FY, WIDTH / 2, HEIGHT / 2]),
        ({"w": None, "h": None}, [FX, FY, CX, CY]),
        ({"w": WIDTH / 2, "h": HEIGHT / 2}, [FX * 2, FY * 2, CX * 2 - 10, CY * 2 - 5]),
        ({"fl_x": None, "fl_y": None, "camera_angle_x": 1.0}, [28 / math.tan(0.5)] * 2 + [CX, CY]),
        (
            {"fl_x": None, "camera_angle_x": 1.0, "camera_angle_y": 0.8},
            [28 / math.tan(0.5), 20 / math.tan(0.4), CX, CY],
        ),
        ({"camera_angle_x": 1.0}, [FX, FY, CX, CY]),
    ],
    ids=["fl_x", "no centre", "no size", "half size", "angle", "two angles", "focal before angle"],
)
def test_flavours_of_intrinsics(tmp_path, changes, expected):
    write_nerfstudio(tmp_path)
    if expected[2] == CX * 2 - 10:
        changes = {**changes, "cx": CX - 5, "cy": CY - 2.5}
    edit(tmp_path, top_edit(**changes))
    K = read_transforms(tmp_path).frames[0].pinhole.K(HEIGHT, WIDTH)
    assert [K[0, 0], K[1, 1], K[0, 2], K[1, 2]] == pytest.approx(expected)


def test_the_last_row_of_a_pose_may_be_missing(tmp_path):
    poses = write_nerfstudio(tmp_path)
    edit(tmp_path, frame_edit(0, transform_matrix=poses[0, :3].tolist()))
    np.testing.assert_allclose(read_transforms(tmp_path).c2w, poses @ GL_TO_CV)


@pytest.mark.parametrize(
    ("stored", "suffix"), [("r_0.png", ""), ("r_0.JPG", ".JPG"), ("r_0.tiff", ".tiff"), ("r_0.5.jpg", "")]
)
def test_images_are_found_with_and_without_suffix(tmp_path, stored, suffix):
    (tmp_path / stored).touch()
    wanted = stored if suffix else stored.rpartition(".")[0]
    assert find_image(tmp_path / wanted) == tmp_path / stored
    assert find_image(tmp_path / "r_1") is find_image(tmp_path / "nowhere/r_0") is None


@pytest.mark.parametrize(
    ("listed", "stored"),
    [
        ("DJI_0001", "DJI_0001.JPG"),
        ("DJI_0001", "DJI_0001.Jpeg"),
        ("DJI_0001.jpg", "DJI_0001.JPG"),
        ("dji_0001.JPG", "DJI_0001.jpg"),
        ("0001", "0001.TIF"),
        ("caf\u00e9.png", "cafe\u0301.png"),
    ],
)
def test_capitals_and_accents_need_not_be_those_of_the_files(tmp_path, listed, stored):
    assert find_image(tmp_path / listed) is None
    (tmp_path / stored).touch()
    (tmp_path / "other.png").touch()
    assert find_image(tmp_path / listed) == tmp_path / stored
    (tmp_path / listed).touch()
    assert find_image(tmp_path / listed) == tmp_path / listed


def test_another_suffix_than_the_listed_one_is_another_file(tmp_path):
    (tmp_path / "r_0.jpg").touch()
    assert find_image(tmp_path / "r_0.png") is None


def pose(**changes) -> list[list[float]]:
    matrix = cameras(1)[0]
    for entry, value in changes.items():
        matrix[int(entry[1]), int(entry[2])] = value
    return matrix.tolist()


CASES = {
    "no frames": (top_edit(frames=None), "expected a key 'frames' with a list"),
    "frames are an object": (top_edit(frames={}), "expected a list as 'frames'"),
    "empty frames": (top_edit(frames=[]), "'frames' is empty"),
    "frame is a word": (lambda c: c["frames"].insert(1, "r_1"), r"frames\[1\]: expected a key 'file_path'"),
    "no file_path": (frame_edit(2, file_path=None), r"frames\[2\]: expected a key 'file_path'"),
    "number for file_path": (frame_edit(2, file_path=2), r"frames\[2\]: expected a str as 'file_path'"),
    "empty file_path": (frame_edit(2, file_path=""), r"frames\[2\]: '' as 'file_path' names no file"),
    "folder for file_path": (frame_edit(2, file_path="images/.."), r"names no file"),
    "NUL in file_path": (frame_edit(2, file_path="a\0b.png"), r"names no file"),
    "mask is a number": (frame_edit(2, mask_path=1), r"frames\[2\].*expected a str as 'mask_path'"),
    "twice": (frame_edit(2, file_path="images/frame_00002.png"), r"1 views are there twice, first .*frame_00002"),
    "no pose": (frame_edit(2, transform_matrix=None), r"frames\[2\] \(images/frame_00003\.png\).*'transform_matrix'"),
    "short pose": (frame_edit(2, transform_matrix=[[1, 0], [0, 1]]), r"frames\[2\].*expected 4x4 numbers"),
    "ragged pose": (frame_edit(2, transform_matrix=[[1], [0, 1], [2], [3]]), r"frames\[2\].*expected 4x4 numbers"),
    "words for a pose": (frame_edit(2, transform_matrix=["a"] * 16), r"frames\[2\].*expected 4x4 numbers"),
    "nan pose": (frame_edit(2, transform_matrix=pose(p03=math.nan)), r"frames\[2\].*NaN"),
    "infinite pose": (frame_edit(2, transform_matrix=pose(p11=math.inf)), r"frames\[2\].*infinity"),
    "scaled pose": (frame_edit(2, transform_matrix=pose(p00=2.0)), r"frames\[2\].*not rigid"),
    "huge pose": (frame_edit(2, transform_matrix=(np.eye(4) * 1e200).tolist()), r"frames\[2\].*not rigid"),
    "pose of overflowing products": (
        frame_edit(2, transform_matrix=[[1e200, 1e200, 0, 0], [1e200, -1e200, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]),
        r"frames\[2\].*not rigid",
    ),
    "mirrored pose": (frame_edit(2, transform_matrix=np.diag([1.0, 1, -1, 1]).tolist()), r"frames\[2\].*mirrors"),
    "far away": (
        lambda c: [f["transform_matrix"][0].__setitem__(3, f["transform_matrix"][0][3] + 5e6) for f in c["frames"]],
        "from the world's origin, too far for single precision",
    ),
    "endlessly far away": (frame_edit(2, transform_matrix=pose(p03=1e200)), r"frames\[2\].*too far from the origin"),
    "no intrinsics": (top_edit(fl_x=None), r"frames\[0\].*no intrinsics; expected 'fl_x'"),
    "negative focal length": (top_edit(fl_x=-5), r"focal length \(-5\.0, 55\.0\)"),
    "word for focal length": (top_edit(fl_x="60"), r"expected a number as 'fl_x', found '60'"),
    "truth for focal length": (top_edit(fl_x=True), r"expected a number as 'fl_x', found True"),
    "nan focal length": (top_edit(fl_x=math.nan), r"expected a finite number as 'fl_x', found nan"),
    "endless number": (top_edit(fl_x=10**400), r"expected a finite number as 'fl_x', found 1000"),
    "angle too wide": (top_edit(fl_x=None, camera_angle_x=3.2), r"field of view \(3\.2, None\)"),
    "angle of zero": (top_edit(fl_x=None, camera_angle_x=0), r"field of view \(0\.0, None\)"),
    "half a centre": (top_edit(cy=None), "of 'cx' and 'cy' one is missing"),
    "half a size": (top_edit(w=None), "of 'w' and 'h' one is missing"),
    "size of zero": (top_edit(w=0), "size 0.0x40.0"),
    "rational distortion": (top_edit(k1=0.02, k5=0.1), r"k5 = 0\.1 and k6 = 0 .* rational.*undistort the images"),
    "rational distortion of a frame": (frame_edit(1, k6=-0.1), r"frames\[1\].*k6 = -0\.1"),
    "distortion is a word": (top_edit(k1="weak"), r"expected a number as 'k1', found 'weak'"),
    "nan distortion": (top_edit(p2=math.nan), r"expected a finite number as 'p2'"),
    "fisheye": (top_edit(camera_model="OPENCV_FISHEYE", k1=0.1), r"'OPENCV_FISHEYE', only perspective.*undistort"),
    "fisheye flag": (top_edit(is_fisheye=True), r"a fisheye, only perspective"),
    "odd camera model": (top_edit(camera_model=["a"]), r"only perspective"),
    "near is a word": (top_edit(near="close"), "expected a number as 'near', found 'close'"),
}


@pytest.mark.parametrize("name", CASES)
def test_damaged_content(tmp_path, name):
    write_nerfstudio(tmp_path)
    change, message = CASES[name]
    edit(tmp_path, change)
    with pytest.raises(DataError, match=message) as error:
        read_transforms(tmp_path)
    assert str(tmp_path / "transforms.json") in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("height", "width", "changes", "message"),
    [
        (WIDTH, HEIGHT, {}, r"intrinsics are for w x h = 56x40, but the image is 40x56"),
        (HEIGHT, WIDTH, {"fl_y": 1e-300}, r"focal lengths of 60 and 1e-300 pixels are no lens's in an image 56 wide"),
        (HEIGHT, WIDTH, {"cx": 57.0}, r"principal point \(57, 21\.5\) lies outside the image of 56x40"),
        (20, 28, {"w": None, "h": None}, r"principal point \(26, 21\.5\) lies outside the image of 28x20.*'w' and 'h'"),
    ],
)
def test_intrinsics_of_other_images(tmp_path, height, width, changes, message):
    write_nerfstudio(tmp_path)
    edit(tmp_path, top_edit(**changes))
    frame = read_transforms(tmp_path).frames[0]
    with pytest.raises(DataError, match=message) as error:
        frame.pinhole.K(height, width)
    assert f"{tmp_path}/transforms.json: frames[0] (images/frame_00001.png)" in str(error.value)


@pytest.mark.parametrize(
    "content", [b"", b"{", b"[1, 2]", b"\xff\xfe{}", b"[" * 100000, b'{"frames": ' + b"9" * 5000 + b"}"]
)
def test_what_is_no_json_object(tmp_path, content):
    (tmp_path / "transforms.json").write_bytes(content)
    with pytest.raises(DataError, match=r"transforms\.json: expected"):
        read_transforms(tmp_path)


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "utf-16-be"])
def test_a_byte_order_mark_is_no_part_of_the_text(tmp_path, encoding):
    write_nerfstudio(tmp_path)
    text = (tmp_path / "transforms.json").read_text()
    mark = "\ufeff" if encoding == "utf-16-be" else ""
    (tmp_path / "transforms.json").write_text(mark + text.replace("images/", "imäges/"), encoding=encoding)
    assert read_transforms(tmp_path).frames[0].image == tmp_path / "imäges/frame_00001.png"


def test_no_file_at_all(tmp_path):
    assert not is_scene(tmp_path)
    with pytest.raises(DataError, match=r"no transforms\.json and no transforms_train\.json.*in every scene's folder"):
        read_transforms(tmp_path)
