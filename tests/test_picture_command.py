"""Pictures to folders of what a person opens next, with the shipped model."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from nerfdiff.cli import load_config
from nerfdiff.commands.picture import check
from nerfdiff.fit.saved_field import load_field
from nerfdiff.inputs import ASSETS, NO_SCENE
from nerfdiff.pictures import folders, pictures
from nerfdiff.stopping import Stopped, stop
from nerfdiff.utils.errors import ConfigError, DataError, UserError
from photographs import photograph

SMALL = [
    *("budget.steps=1", "budget.sampler_steps=1", "budget.inner_steps=1", "budget.rays=64", "budget.views=2"),
    *(
        "path.frames=2",
        "height=16",
        "mesh.resolution=24",
        "mesh.colour_views=1",
        "points=100",
        "viewer.cells=8",
        "progress_every=null",
    ),
]


def made(tmp_path, *words: str):
    check(cfg := load_config("picture", [*SMALL, f"out={tmp_path / 'out'}", "device=cpu", *words]))
    return pictures(cfg)


@pytest.fixture
def photo(tmp_path, monkeypatch):
    monkeypatch.setenv("U2NET_HOME", str(tmp_path / "none"))
    image = np.asarray(Image.open(ASSETS / "pictures" / "wagon.png").convert("RGB"))
    photograph(image, (image < 242).any(-1), tmp_path / "my car.jpg", (150, 200), (0.5, 0.5), 0.75, 0)
    return tmp_path / "my car.jpg"


def test_a_photograph_becomes_a_folder(photo, tmp_path, caplog, capsys):
    (car,) = made(tmp_path, f"images=['{photo}']", "elevation=8")
    files = {"field.safetensors", "scene.json", "views.png", "orbit.mp4", "viewer.html", "my_car.glb", "my_car.ply"}
    assert {path.name for path in car.iterdir()} == files | {"mask.png", "cutout.png"}
    assert "my car.jpg: the object was cut out by its" in caplog.text
    assert "mask=<image of its size" in caplog.text and "the scene of my_car is suspect: " in caplog.text
    up = load_field(car / "field.safetensors").stands.up
    assert float(np.degrees(np.arctan2(-up[2], -up[1]))) == pytest.approx(8, abs=0.1)
    said = capsys.readouterr().out
    assert "next: look at" in said and f"field={car / 'field.safetensors'}" in said

    # again: the scene is kept, lost files are made anew
    before = (car / "field.safetensors").stat().st_mtime_ns
    (car / "my_car.glb").unlink()
    made(tmp_path, f"images=['{photo}']", "elevation=8", "format=[glb]")
    assert (car / "my_car.glb").exists() and (car / "field.safetensors").stat().st_mtime_ns == before
    # a mask of one's own is another scene
    mask = Image.open(car / "mask.png")
    mask.save(tmp_path / "own.png")
    made(tmp_path, f"images=['{photo}']", f"mask={tmp_path / 'own.png'}", "elevation=8", "format=[ply]")
    assert (car / "field.safetensors").stat().st_mtime_ns > before
    facts = json.loads((car / "scene.json").read_text())
    assert facts["picture"] == str(photo) and facts["verdict"].startswith("suspect: ")  # one step makes no scene
    assert facts["verdict"] in capsys.readouterr().out


def test_a_picture_that_fails_leaves_the_others(tmp_path, caplog):
    Image.new("RGB", (40, 30), (90, 90, 90)).save(tmp_path / "grey.png")
    wagon = ASSETS / "pictures" / "wagon.png"
    with pytest.raises(DataError, match="1 of 2 pictures failed"):
        made(tmp_path, f"images=['{tmp_path / 'grey.png'}','{wagon}']", "strategy=none", "format=[gif]")
    assert "grey.png: no object stands out" in caplog.text
    folder, shown = sorted((tmp_path / "out").iterdir(), reverse=True)
    assert list(shown.glob("picture/wagon strategy=none/events.*")) and shown.name == "tensorboard"
    assert {path.name for path in folder.iterdir()} == {"field.safetensors", "scene.json", "views.png", "orbit.gif"}
    assert folder.name == "wagon" and "wagon.png: its background" not in caplog.text


def test_pictures_of_one_name_get_folders_of_their_own(tmp_path):
    found = folders(["a/car.jpg", "b/car.png", "b/van.png", "c/car.jpg"], tmp_path)
    assert [path.name for path in found] == ["car", "car_2", "van", "car_3"]


def test_a_box_is_taken_before_white_too_and_not_beside_a_mask(tmp_path, caplog):
    wagon = str(ASSETS / "pictures" / "wagon.png")
    words = [f"images=['{wagon}']", "strategy=none", "format=[png]", "box=[10,30,118,100]"]
    (folder,) = made(tmp_path, *words)
    assert (folder / "mask.png").exists() and "wagon.png: the object was cut out" in caplog.text
    assert not np.asarray(Image.open(folder / "mask.png"))[:30].any()
    with pytest.raises(ConfigError, match="both say where the object is"):
        made(tmp_path, *words, f"mask={wagon}")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ([], "name a picture: "),
        (["images=[a.png,b.png]", "mask=m.png"], "mask=m.png is of one picture, and there are 2"),
        (["images=[a.png,b.png]", "box=[1,2,30,40]"], "box=.* is of one picture, and there are 2"),
        (["images=[a.png]", "format=[stl]"], "'stl'.*glb"),
        (["images=[a.png]", "box=[1,2]"], r"box=\[1, 2\]: expected"),
        (["images=[a.png]", "box=[a,b,c,d]"], r"box=\['a', 'b', 'c', 'd'\]: expected"),
        (["images=[a.png]", "box=[0,0,9,8.5]"], r"box=\[0, 0, 9, 8\.5\]: .* within the picture's 9x8 "),
        (["images=[a.png]", "box=[1,2,30,40]", "mask=m.png"], "both say where the object is"),
        *((["images=[a.png]", f"strategy={name}"], f"strategy={name} leaves no scene") for name in NO_SCENE),
        (["images=[empty.png]"], "empty.png: .*empty"),
        (["images=[a.png,text.png]"], "text.png: "),
        (["images=[a.png]", "mask=text.png"], "text.png: "),
        (["images=[a.png]", "mask=m.png"], r"m\.png: a mask of 9x7 for a\.png of 8x9 \(height x width\)"),
    ],
)
def test_what_cannot_be_is_said_first(tmp_path, words, said, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Image.new("RGB", (9, 8)).save("a.png")
    Image.new("L", (7, 9)).save("m.png")
    Path("empty.png").touch()
    Path("text.png").write_text("a picture of a car\n")
    with pytest.raises(UserError, match=said):
        check(load_config("picture", words))


def test_what_can_be_passes(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Image.new("RGB", (9, 8)).save("a.png")
    turned = Image.new("L", (8, 9))
    turned.getexif()[0x0112] = 6  # by a quarter
    turned.save("turned.png", exif=turned.getexif())
    check(load_config("picture", ["images=[a.png,a.png]", "strategy=none", "format=[glb]"]))
    check(load_config("picture", ["images=[a.png]", "mask=turned.png"]))
    check(load_config("picture", ["images=[a.png]", "box=[0,0,9,8]"]))


def test_a_stopped_command_says_what_is_complete(tmp_path, monkeypatch):
    def stop_at_the_second(cfg, model, image, folder):
        if folder.name == "wagon_2":
            stop(2)

    monkeypatch.setattr("nerfdiff.pictures._make", stop_at_the_second)
    wagon = ASSETS / "pictures" / "wagon.png"
    with pytest.raises(Stopped, match="1 of 2 pictures are complete; a scene in the making begins anew") as stopped:
        made(tmp_path, f"images=['{wagon}','{wagon}']")
    assert stopped.value.signum == 2


def test_one_picture_fails_with_one_message(tmp_path, caplog):
    Image.new("RGB", (40, 30), (90, 90, 90)).save(tmp_path / "grey.png")
    caplog.set_level("INFO")
    with pytest.raises(DataError, match=r"grey\.png: no object stands out"):
        made(tmp_path, f"images=['{tmp_path / 'grey.png'}']")
    assert "no object" not in caplog.text
    first = caplog.records[0].message
    assert first == "ckpt=demo: 64x64 pixels, trained on procedural cars seen from elevations of 0 to 90 degrees"
