"""The SRN reader on layouts whose every pixel is known."""

import shutil

import numpy as np
import pytest
import torch
from PIL import Image

from data_fixtures import COLOURS, CX, CY, FAR, HEIGHT, NEAR, POINTS, WIDTH, F, draw, visible, write_scene, write_srn
from nerfdiff.data.readers.srn import SRNReader
from nerfdiff.data.scene import MissingSplit
from nerfdiff.utils.errors import DataError


def read(root, split="train", category="cars", image_size=None) -> SRNReader:
    return SRNReader(root, category, split, NEAR, FAR, image_size)


def assert_points_found(scene, tolerance: int = 0) -> None:
    """The known colours lie where the scene's own cameras project the known points."""
    pixels, _ = scene.cameras.project(torch.from_numpy(POINTS).float())
    checked = 0
    for v, pose in enumerate(scene.cameras.c2w.double().numpy()):
        for k in visible(pose):
            column, row = pixels[v, k].floor().long()
            difference = scene.pixels[v, :, row, column].int() - torch.from_numpy(COLOURS[k]).int()
            assert difference.abs().max() <= tolerance
            checked += 1
    assert checked >= 2 * len(scene.views)


def test_scene_holds_exactly_what_was_written(tmp_path):
    poses = write_srn(tmp_path)["train/scene1"]
    reader = read(tmp_path)
    assert len(reader) == 3 and reader.scene_id(1) == "scene1"
    assert reader.view_names(1) == tuple(f"{k:06d}" for k in range(5))
    scene = reader.load(1)
    assert (scene.id, scene.near, scene.far, scene.mask, scene.depth) == ("scene1", NEAR, FAR, None, None)
    assert scene.pixels.shape == (5, 3, HEIGHT, WIDTH) and scene.pixels.dtype == torch.uint8
    assert np.array_equal(scene.pixels.permute(0, 2, 3, 1), np.stack([draw(pose) for pose in poses]))
    np.testing.assert_allclose(scene.cameras.c2w, poses, atol=1e-7)
    expected = torch.tensor([[F, 0, CX], [0, F, CY], [0, 0, 1]]).expand(5, 3, 3)
    assert torch.equal(scene.cameras.K, expected)
    assert (scene.cameras.height, scene.cameras.width) == (HEIGHT, WIDTH)
    assert torch.equal(scene.images, scene.pixels.double().div(255).float())
    assert_points_found(scene)


def test_views_are_read_in_the_order_asked_for(tmp_path):
    write_srn(tmp_path)
    reader = read(tmp_path)
    whole, part = reader.load(0), reader.load(0, [3, 0])
    assert part.views == ("000003", "000000")
    assert torch.equal(part.pixels, whole.pixels[[3, 0]])
    assert torch.equal(part.cameras.c2w, whole.cameras.c2w[[3, 0]])


def test_only_the_views_asked_for_are_decoded(tmp_path):
    write_srn(tmp_path)
    (tmp_path / "cars_train/scene0/rgb/000001.png").write_bytes(b"damaged")
    assert read(tmp_path).load(0, [0, 2]).views == ("000000", "000002")


@pytest.mark.parametrize("parent", ["", "srn_cars", "srn_cars/srn_cars"])
def test_top_folders_are_probed(tmp_path, parent):
    write_srn(tmp_path / parent)
    assert len(read(tmp_path)) == 3
    assert len(read(tmp_path, "test")) == 2


def test_chairs_are_nested_in_training_only(tmp_path):
    write_scene(tmp_path / "chairs_train/chairs_2.0_train/a")
    write_scene(tmp_path / "chairs_train/chairs_2.0_train/b", seed=1)
    write_scene(tmp_path / "chairs_test/c", seed=2)
    assert read(tmp_path, category="chairs").scenes == ("a", "b")
    assert read(tmp_path, "test", category="chairs").scenes == ("c",)


def test_a_missing_split_says_so_only_when_asked_for(tmp_path):
    write_srn(tmp_path, {"train": 1})
    assert len(read(tmp_path)) == 1
    with pytest.raises(MissingSplit) as error:
        read(tmp_path, "val")
    for word in (str(tmp_path), "cars_val", "srn_cars/cars_val", "srn_cars/srn_cars/cars_val", "cars_train"):
        assert word in str(error.value)


def test_hidden_and_stray_files_are_no_scenes_or_views(tmp_path):
    write_srn(tmp_path)
    (tmp_path / "cars_train/.DS_Store").touch()
    (tmp_path / "cars_train/README.txt").touch()
    (tmp_path / "cars_train/.partial").mkdir()
    (tmp_path / "cars_train/scene0/rgb/._000000.png").touch()
    reader = read(tmp_path)
    assert len(reader) == 3 and len(reader.load(0).views) == 5


def test_poses_belong_to_images_by_name(tmp_path):
    poses = write_srn(tmp_path, {"train": 1}, views=[3, 20, 100])["train/scene0"]
    scene = read(tmp_path).load(0)
    assert scene.views == ("000003", "000020", "000100")
    np.testing.assert_allclose(scene.cameras.c2w, poses, atol=1e-7)


def test_poses_may_stand_on_four_lines(tmp_path):
    poses = write_srn(tmp_path)["train/scene0"]
    for k, pose in enumerate(poses):
        text = "\n".join(" ".join(map(repr, row)) for row in pose.tolist()) + "\n"
        (tmp_path / f"cars_train/scene0/pose/{k:06d}.txt").write_text(text)
    np.testing.assert_allclose(read(tmp_path).load(0).cameras.c2w, poses, atol=1e-7)


@pytest.mark.parametrize("flag", ["0", "1"])
def test_fifth_line_of_intrinsics_says_whether_poses_are_world2cam(tmp_path, flag):
    poses = write_srn(tmp_path)["train/scene0"]
    folder = tmp_path / "cars_train/scene0"
    with open(folder / "intrinsics.txt", "a") as file:
        file.write(flag + "\n")
    if flag == "1":
        for k, pose in enumerate(poses):
            (folder / f"pose/{k:06d}.txt").write_text(" ".join(map(repr, np.linalg.inv(pose).ravel().tolist())))
    scene = read(tmp_path).load(0)
    np.testing.assert_allclose(scene.cameras.c2w, poses, atol=1e-6)
    assert_points_found(scene)


def test_intrinsics_of_another_resolution_are_scaled(tmp_path):
    write_srn(tmp_path)
    text = f"{4 * F} {4 * CX} {4 * CY} 0.\n0. 0. 0.\n1.\n{4 * HEIGHT} {4 * WIDTH}\n"
    (tmp_path / "cars_train/scene0/intrinsics.txt").write_text(text)
    scene = read(tmp_path).load(0)
    assert torch.equal(scene.cameras.K[0], torch.tensor([[F, 0, CX], [0, F, CY], [0, 0, 1]]))
    assert_points_found(scene)


def test_intrinsics_may_be_given_per_view(tmp_path):
    write_srn(tmp_path)
    folder = tmp_path / "cars_train/scene0"
    (folder / "intrinsics.txt").unlink()
    (folder / "intrinsics").mkdir()
    for k in range(5):
        (folder / f"intrinsics/{k:06d}.txt").write_text(f"{F + k} 0 {CX}\n0 {F} {CY}\n0 0 1\n")
    K = read(tmp_path).load(0, [4, 1]).cameras.K
    assert K[:, 0, 0].tolist() == [F + 4, F + 1] and K[:, 1, 1].tolist() == [F, F]
    half = read(tmp_path, image_size=(20, 28)).load(0, [4]).cameras.K[0]
    assert torch.equal(half, torch.tensor([[(F + 4) / 2, 0, CX / 2], [0, F / 2, CY / 2], [0, 0, 1]]))


@pytest.mark.parametrize("size", [(20, 28), (80, 112), (30, 42), (20, 56), (40, 84)])
def test_resized_images_keep_points_at_their_projections(tmp_path, size):
    write_srn(tmp_path, radius=3)
    scene = read(tmp_path, image_size=size).load(0)
    assert scene.pixels.shape[-2:] == size == (scene.cameras.height, scene.cameras.width)
    pixels, _ = scene.cameras.project(torch.from_numpy(POINTS).float())
    checked = 0
    for v, pose in enumerate(scene.cameras.c2w.double().numpy()):
        for k in visible(pose, radius=3):
            column, row = pixels[v, k].floor().long()
            difference = scene.pixels[v, :, row, column].int() - torch.from_numpy(COLOURS[k]).int()
            assert difference.abs().max() <= 12
            checked += 1
    assert checked >= 5


def test_an_image_size_of_one_number_is_a_square(tmp_path):
    write_srn(tmp_path)
    assert read(tmp_path, image_size=32).load(0).pixels.shape[-2:] == (32, 32)


def test_alpha_and_grey_images_load_beside_colour(tmp_path):
    write_srn(tmp_path)
    folder = tmp_path / "cars_train/scene0/rgb"
    rgba = np.zeros((HEIGHT, WIDTH, 4), np.uint8)
    Image.fromarray(rgba).save(folder / "000000.png")
    Image.fromarray(rgba[..., 0] + 7).save(folder / "000001.png")
    pixels = read(tmp_path).load(0).pixels
    assert (pixels[0] == 255).all() and (pixels[1] == 7).all() and pixels.shape[1] == 3


def test_an_all_white_scene_loads(tmp_path):
    write_srn(tmp_path, truth=True)
    for k in range(5):
        white = np.full((HEIGHT, WIDTH, 3), 255, np.uint8)
        Image.fromarray(white).save(tmp_path / f"cars_train/scene0/rgb/{k:06d}.png")
        Image.fromarray(white[..., 0] * 0).save(tmp_path / f"cars_train/scene0/mask/{k:06d}.png")
    scene = read(tmp_path).load(0, truth=True)
    assert (scene.images == 1).all() and not scene.mask.any()


def test_ground_truth_is_read_when_asked_for(tmp_path):
    poses = write_srn(tmp_path, truth=True)["train/scene0"]
    assert read(tmp_path).load(0).mask is None
    scene = read(tmp_path).load(0, [1, 2], truth=True)
    foreground = torch.from_numpy(np.stack([(draw(pose) != 255).any(-1) for pose in poses[1:3]]))
    assert torch.equal(scene.mask, foreground)
    assert torch.equal(scene.depth, torch.where(foreground, 1.3, 0.0))
    small = read(tmp_path, image_size=(20, 28)).load(0, [1], truth=True)
    assert small.depth.shape == small.mask.shape == (1, 20, 28)
    assert small.depth.unique().tolist() == pytest.approx([0.0, 1.3])


def test_the_fingerprint_follows_files_not_their_place(tmp_path):
    write_srn(tmp_path / "one", truth=True)
    first = read(tmp_path / "one").fingerprint()
    shutil.copytree(tmp_path / "one", tmp_path / "two")
    assert read(tmp_path / "two").fingerprint() == first
    (tmp_path / "two/cars_train/scene0/depth/000000.npz").unlink()
    assert read(tmp_path / "two").fingerprint() == first
    (tmp_path / "two/cars_train/scene2/pose/000003.txt").write_text("changed")
    changed = read(tmp_path / "two").fingerprint()
    assert changed != first
    (tmp_path / "two/cars_train/scene2/pose/000003.txt").rename(tmp_path / "two/cars_train/scene2/pose/000009.txt")
    assert read(tmp_path / "two").fingerprint() not in (first, changed)


def test_the_identity_tells_folder_split_and_size(tmp_path):
    write_srn(tmp_path / "one")
    write_srn(tmp_path / "two")
    readers = [
        read(tmp_path / "one"),
        read(tmp_path / "two"),
        read(tmp_path / "one", "test"),
        read(tmp_path / "one", image_size=32),
    ]
    assert len({reader.identity for reader in readers}) == 4
    assert read(tmp_path / "one", image_size=[32, 32]).identity == readers[3].identity


@pytest.mark.parametrize("size", [f"{HEIGHT} {WIDTH}", f"{2 * HEIGHT} {2 * WIDTH}"])
def test_photographs_stored_lying_are_turned_to_fit_the_intrinsics(tmp_path, size):
    write_srn(tmp_path)
    folder = tmp_path / "cars_train/scene1"
    if size != f"{HEIGHT} {WIDTH}":
        (folder / "intrinsics.txt").write_text(f"{2 * F} {2 * CX} {2 * CY} 0.\n0. 0. 0.\n1.\n{size}\n")
    for file in (folder / "rgb").iterdir():
        with Image.open(file) as image:
            lying = image.transpose(Image.Transpose.ROTATE_90)
        exif = lying.getexif()
        exif[0x0112] = 6
        lying.save(file, exif=exif)
    assert_points_found(read(tmp_path).load(1))
    (folder / "intrinsics.txt").unlink()
    (folder / "intrinsics").mkdir()  # the flavour that states no size
    with pytest.raises(DataError, match=r"scene1/rgb/000000\.png: its EXIF tag Orientation is 6"):
        read(tmp_path).load(1)


def test_missing_truth_of_one_view_is_an_error(tmp_path):
    write_srn(tmp_path, truth=True)
    (tmp_path / "cars_train/scene0/depth/000002.npz").unlink()
    with pytest.raises(DataError, match=r"depth/000002\.npz"):
        read(tmp_path).load(0, truth=True)
