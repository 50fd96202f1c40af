"""Objects of stand-ins for photographs are found; where that is doubtful or impossible, it is said."""

import sys
from types import SimpleNamespace

import numpy as np
import pytest
from hydra.utils import instantiate
from PIL import Image

from nerfdiff.cli import load_config
from nerfdiff.data.cutout import CutOut, _doubts, write_mask
from nerfdiff.inputs import ASSETS
from nerfdiff.utils.errors import ConfigError, DataError
from photographs import bricks, noise, photograph


@pytest.fixture(autouse=True)
def no_network(tmp_path, monkeypatch):
    monkeypatch.setenv("U2NET_HOME", str(tmp_path / "none"))


def cut_out(**changes) -> CutOut:
    return instantiate(load_config("picture", []).cutout, **changes)


def wagon() -> tuple[np.ndarray, np.ndarray]:
    """The shipped picture, and where it is not transparent or white."""
    image = np.asarray(Image.open(ASSETS / "pictures" / "wagon.png").convert("RGBA"))
    where = (image[..., 3] > 127) & (image[..., :3] < 242).any(-1)
    return image[..., :3], where


def iou(a, b) -> float:
    return (a & b).sum() / (a | b).sum()


@pytest.mark.parametrize(
    ("size", "centre", "share", "seed"),
    [
        ((300, 400), (0.5, 0.5), 0.75, 0),
        ((300, 400), (0.4, 0.55), 0.7, 7),
        ((3000, 4000), (0.6, 0.5), 0.6, 0),  # 12 megapixels
    ],
)
def test_the_object_of_a_photograph_is_found(tmp_path, size, centre, share, seed):
    truth = photograph(*wagon(), tmp_path / "car.jpg", size, centre, share, seed)
    found = cut_out().find(tmp_path / "car.jpg")
    assert found.where.shape == size and iou(found.where, truth) > 0.85
    assert "without a network" in found.how
    assert [doubt for doubt in found.doubts if "is an edge of colours" not in doubt] == []


def test_bricks_are_no_object(tmp_path):
    truth = photograph(*wagon(), tmp_path / "car.jpg", (300, 400), (0.45, 0.6), 0.7, 0, bricks((300, 400), 0))
    assert iou(cut_out().find(tmp_path / "car.jpg").where, truth) > 0.75


def test_a_box_says_which_object_is_meant(tmp_path):
    photograph(*wagon(), tmp_path / "a.png", (300, 400), (0.25, 0.55), 0.5, 0)
    both = np.asarray(Image.open(tmp_path / "a.png").convert("RGB")) / 255
    truth = photograph(*wagon(), tmp_path / "two.png", (300, 400), (0.75, 0.5), 0.5, 0, both)
    rows, columns = (np.flatnonzero(truth.any(axis)) for axis in (1, 0))
    box = [int(edge) for edge in (columns[0] - 6, rows[0] - 6, columns[-1] + 8, rows[-1] + 5)]
    found = cut_out(box=box).find(tmp_path / "two.png")
    assert iou(found.where, truth) > 0.8 and found.doubts == ()
    assert "another part of the picture stands out as well" in cut_out().find(tmp_path / "two.png").doubts
    for box in ([0, 0, 4, 100], [300, 10, 100, 90], [0, 0, 401, 300]):
        with pytest.raises(ConfigError, match=r"box=\[.*within the picture's 400x300"):
            cut_out(box=box).find(tmp_path / "two.png")


@pytest.mark.parametrize("size", [(1, 1), (2, 2), (3, 3), (7, 40), (2, 300), (300, 2), (29, 300), (16, 2000)])
@pytest.mark.parametrize("mode", ["RGB", "RGBA"])
@pytest.mark.filterwarnings("error")
def test_a_picture_without_room_for_an_object_is_refused(tmp_path, size, mode):
    pixels = np.random.default_rng(0).integers(0, 255, (*size, len(mode)), np.uint8)
    pixels[..., 3:] = 255
    Image.fromarray(pixels).save(tmp_path / "one.png")
    said = rf"one\.png: {size[1]}x{size[0]} pixels .* at least \d+\. Give a larger picture"
    with pytest.raises(DataError, match=said):
        cut_out().find(tmp_path / "one.png")


@pytest.mark.parametrize("size", [(8, 8), (30, 300), (300, 31), (200, 2000)])
def test_a_narrow_picture_is_looked_at(tmp_path, size):
    Image.new("RGB", size, (90, 90, 90)).save(tmp_path / "grey.png")
    with pytest.raises(DataError, match="no object stands out"):
        cut_out().find(tmp_path / "grey.png")


def test_a_photograph_held_upright_is_cut_out_upright(tmp_path):
    truth = photograph(*wagon(), tmp_path / "car.jpg", (300, 400), (0.4, 0.5), 0.7, 0)
    image = Image.open(tmp_path / "car.jpg")
    image.getexif()[0x0112] = 6  # turned by a quarter
    image.save(tmp_path / "turned.jpg", exif=image.getexif(), quality=95)
    assert iou(cut_out().find(tmp_path / "turned.jpg").where, np.rot90(truth, -1)) > 0.85


def test_a_photograph_of_nothing_is_refused_and_says_what_to_give(tmp_path):
    for name, pixels in (("grey", np.full((60, 80, 3), 0.5)), ("noise", noise((60, 80), 0, 0.0))):
        Image.fromarray((pixels * 255).astype(np.uint8)).save(tmp_path / f"{name}.png")
    with pytest.raises(DataError, match=r"grey\.png: no object stands out.*give a mask"):
        cut_out().find(tmp_path / "grey.png")


def test_masks_that_may_be_wrong_are_doubted():
    where = np.zeros((100, 100), bool)
    where[40:60, 40:] = True
    assert [doubt.split(" ")[1] for doubt in _doubts("a.png", where)] == ["touches"]
    where[:] = False
    where[50:60, 50:60] = True
    assert _doubts("a.png", where) == ("it covers only 1.0% of the picture",)


def test_an_object_that_the_border_cuts_is_refused(tmp_path):
    pixels = (noise((120, 160), 1) * 255).astype(np.uint8)
    pixels[30:90, 80:] = (200, 20, 30)
    Image.fromarray(pixels).save(tmp_path / "half.png")
    with pytest.raises(DataError, match=r"half\.png: no object stands out"):
        cut_out().find(tmp_path / "half.png")


def test_the_mask_is_shown_and_can_be_given_back(tmp_path):
    truth = photograph(*wagon(), tmp_path / "car.jpg", (300, 400), (0.5, 0.5), 0.75, 0)
    found = cut_out().find(tmp_path / "car.jpg")
    write_mask(found, tmp_path / "car.jpg", tmp_path / "mask.png", tmp_path / "shown.png")
    assert np.array_equal(np.asarray(Image.open(tmp_path / "mask.png")), found.where)
    shown = np.asarray(Image.open(tmp_path / "shown.png"))
    photo = np.asarray(Image.open(tmp_path / "car.jpg"))
    inside = found.where & truth
    assert np.array_equal(shown[inside], photo[inside]) and (shown[~found.where] >= 128).any(-1).all()


def test_a_networks_weights_are_taken_where_they_are_and_never_fetched(tmp_path, monkeypatch):
    photograph(*wagon(), tmp_path / "car.jpg", (300, 400), (0.5, 0.5), 0.75, 0)
    square = np.zeros((300, 400), np.uint8)
    square[20:40, 30:50] = 255
    asked = []
    rembg = SimpleNamespace(
        new_session=lambda name, **keys: asked.append((name, keys)),
        remove=lambda image, session, only_mask: Image.fromarray(square),
    )
    monkeypatch.setitem(sys.modules, "rembg", rembg)
    assert "without a network" in cut_out().find(tmp_path / "car.jpg").how and asked == []
    home = tmp_path / "weights"
    home.mkdir()
    (home / "u2net.onnx").touch()
    monkeypatch.setenv("U2NET_HOME", str(home))
    found = cut_out().find(tmp_path / "car.jpg")
    assert found.where.sum() == 400 and found.how == "by rembg's u2net" and asked == [("u2net", {})]
    own = str(home / "own.onnx")
    with pytest.raises(ConfigError, match=r"own\.onnx: no such file"):
        cut_out(weights=own).find(tmp_path / "car.jpg")
    (home / "own.onnx").touch()
    cut_out(weights=own).find(tmp_path / "car.jpg")
    assert asked[-1] == ("u2net_custom", {"model_path": own})
    monkeypatch.setitem(sys.modules, "rembg", None)
    with pytest.raises(ConfigError, match=r"pip install 'rembg\[cpu\]'"):
        cut_out().find(tmp_path / "car.jpg")
