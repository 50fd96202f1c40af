"""NerfDiff from Python, with the shipped model."""

import inspect
import warnings
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

import nerfdiff
from nerfdiff.api import _of_picture
from nerfdiff.cli import load_config
from nerfdiff.data.cutout import Mask
from nerfdiff.distill.priors import all_cameras
from nerfdiff.evaluation.run import picture_scene
from nerfdiff.exports.views import render_rgba
from nerfdiff.inputs import ASSETS
from nerfdiff.trajectories import Upright
from nerfdiff.utils.errors import ConfigError, DataError, UserError

WAGON = ASSETS / "pictures" / "wagon.png"
WAGON_ELEVATION = 23  # of its camera, in degrees
SMALL = ["budget.steps=1", "budget.sampler_steps=1", "budget.inner_steps=1", "budget.rays=64", "budget.views=2"]


@pytest.fixture(scope="module")
def model() -> nerfdiff.Model:
    return nerfdiff.load("demo", device="cpu")


@pytest.fixture(scope="module")
def scene(model) -> nerfdiff.Scene:
    with warnings.catch_warnings():
        warnings.filterwarnings("error", ".*LeafSpec")  # a user can do nothing about it
        return model.distil(WAGON, elevation=30, settings=[*SMALL, "picture_views.views=2"])


def test_models_scenes_and_masks_are_shown_in_one_line(model, scene):
    about = "64x64 pixels, trained on procedural cars seen from elevations of 0 to 90 degrees"
    assert repr(model) == f"Model({ASSETS / 'demo' / 'model.safetensors'}: {about}; on cpu)"
    assert repr(scene) == f"Scene(64x64 pixels, on cpu; {scene.verdict})"
    assert repr(replace(scene, verdict=None)) == "Scene(64x64 pixels, on cpu)"
    mask = Mask(np.eye(4, dtype=bool), "by its colours", ())
    assert repr(mask) == "Mask(4x4 pixels, 25% of them the object, found by its colours)"
    assert len(repr(replace(model.loaded, trained_on=()))) < 300


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"settings": ["budget.steps"]}, r"settings=\['budget\.steps'\]: expected a list of key=value"),
        ({"settings": "budget.steps=32"}, "settings='budget.steps=32': expected a list of key=value"),
        ({"settings": [32]}, "expected a list of key=value"),
        ({"settings": ["budget.stepz=32"]}, r"did you mean budget\.steps\?"),
        ({"elevation": "high"}, "elevation='high': expected degrees"),
        ({"elevation": float("nan")}, "elevation=nan: expected degrees"),
        ({"elevation": [3]}, r"elevation=\[3\]: expected degrees"),
        ({"box": "left"}, "box='left': expected .left, top, right, bottom"),
        ({"box": [1, 2, 3]}, r"box=\[1, 2, 3\]: expected"),
        ({"box": 7}, "box=7: expected"),
        ({"settings": ["box=[1,2,3]"]}, r"box=\[1, 2, 3\]: expected"),
        ({"picture": Image.new("RGB", (9, 9))}, "picture=Image: expected the path of a file; save the image"),
        ({"picture": None}, "picture=NoneType: expected the path"),
        ({"picture": ASSETS}, "assets: is a folder; name a picture"),
        ({"picture": "nothere.png"}, "picture=nothere.png: no such file"),
        ({"mask": np.zeros((9, 9))}, "mask=ndarray: expected the path"),
        ({"mask": "nothere.png"}, "mask=nothere.png: no such file"),
        ({"mask": WAGON, "box": [0, 0, 50, 50]}, "both say where the object is"),
        ({"strategy": "mean_image"}, "strategy=mean_image leaves no scene"),
        ({"strategy": "ngd_curent"}, r"no strategy/ngd_curent; did you mean ngd_current\?"),
        ({"seed": "x"}, "seed takes int"),
    ],
)
def test_arguments_that_cannot_be_are_named(model, arguments, said):
    with pytest.raises(UserError, match=said):
        inspect.unwrap(nerfdiff.Model.distil)(model, **({"picture": WAGON} | arguments))  # as without types checked


def test_a_scene_shows_the_picture_and_its_other_sides(scene):
    front, back = scene.render(), scene.render(180, elevation=10, height=32)
    assert (front.mode, front.size, back.size) == ("RGBA", (64, 64), (32, 32))
    pixels = np.asarray(front).astype(float) / 255
    shown = pixels[..., :3] * pixels[..., 3:] + 1 - pixels[..., 3:]
    assert np.abs(shown - np.asarray(scene.picture) / 255).mean() < 0.03
    assert np.asarray(back)[..., 3].max() > 200
    assert scene.verdict == "ok" or scene.verdict.startswith("suspect: ")


def test_what_is_saved_is_the_scene(scene, tmp_path):
    path = scene.save(tmp_path / "car.safetensors")
    again = nerfdiff.load_scene(path, device="cpu")
    shown = (np.asarray(one.render(40), dtype=int) for one in (again, scene))
    assert np.abs(np.subtract(*shown)).max() <= 1  # planes are rounded when they are saved
    scene.orbit(tmp_path / "car.gif", frames=2, height=16)
    again.save(tmp_path / "car.ply", "mesh.resolution=24", "mesh.colour_views=1", "points=100")
    assert Image.open(tmp_path / "car.gif").n_frames == 2 and (tmp_path / "car.ply").stat().st_size > 1000


def test_the_elevation_says_where_up_is(scene):
    up = scene.saved.stands.up
    assert torch.rad2deg(torch.atan2(-up[2], -up[1])) == pytest.approx(30, abs=0.1)
    camera = scene.saved.stands.around(scene.saved.field.cameras, torch.zeros(1), torch.tensor([30.0]))
    assert torch.allclose(camera.c2w, scene.saved.field.cameras.c2w, atol=1e-4)
    assert render_rgba(scene.saved, camera, 16).shape == (1, 4, 16, 16)


def test_pictures_are_framed_as_the_models_were(model, tmp_path, caplog):
    chairs = replace(model.loaded, path=ASSETS / "demo_chairs" / "model.safetensors")
    cfg = load_config("picture", ["picture.object_share=0.5"])
    framed = [_of_picture(cfg, WAGON, loaded).picture for loaded in (model.loaded, chairs)]
    assert [one.object_share for one in framed] == [0.5, 0.5]
    assert [(one.near, one.far) for one in framed] == [pytest.approx(ends) for ends in ((0.8, 1.8), (1.25, 2.75))]
    assert [one.fov for one in framed] == pytest.approx([52, 52], abs=0.1)
    shares = [
        _of_picture(load_config("picture", []), WAGON, loaded).picture.object_share for loaded in (model.loaded, chairs)
    ]
    assert 0.6 < shares[0] < 0.7 and 0.35 < shares[1] < 0.5
    unknown = replace(model.loaded, path=tmp_path / "model.safetensors")
    assert _of_picture(load_config("picture", []), WAGON, unknown).picture.object_centre == [0.5, 0.545]
    assert "does not say how its training images were framed" in caplog.text


def test_the_elevation_is_estimated_where_the_model_can(model, tmp_path, caplog):
    cfg = _of_picture(load_config("picture", []), WAGON, model.loaded)
    scene = picture_scene(cfg, model.loaded, (64, 64))
    assert cfg.picture_views.source_elevation == pytest.approx(WAGON_ELEVATION, abs=8)
    assert "is estimated to look down from" in caplog.text and "say elevation=… if that is wrong" in caplog.text
    up = Upright.seen_by(all_cameras(scene)).up
    assert torch.rad2deg(torch.atan2(-up[2], -up[1])) == pytest.approx(cfg.picture_views.source_elevation, abs=0.1)

    unknown = replace(model.loaded, path=tmp_path / "model.safetensors")
    cfg = _of_picture(load_config("picture", []), WAGON, unknown)
    picture_scene(cfg, unknown, (64, 64))
    assert cfg.picture_views.source_elevation == cfg.usual_elevation == 20
    assert "cannot estimate elevations" in caplog.text
    cfg = _of_picture(load_config("picture", ["elevation=7"]), WAGON, model.loaded)
    picture_scene(cfg, model.loaded, (64, 64))
    assert cfg.picture_views.source_elevation == 7


def test_what_cannot_be_is_named(model, scene, tmp_path):
    cfg = load_config("picture", ["strategy=cdm", "strategy.steps=1", "picture_views.views=2"])
    with pytest.raises(ConfigError, match="strategy=cdm leaves no scene"):
        model.distil_batch(*model.prepare(cfg, WAGON))
    with pytest.raises(ConfigError, match=r"expected one of \.safetensors, \.glb"):
        scene.save(tmp_path / "car.fbx")
    with pytest.raises(ConfigError, match=r"\.mp4 or \.gif"):
        scene.orbit(tmp_path / "car.avi")
    with pytest.raises(DataError, match="not a field saved by this project"):
        nerfdiff.load_scene(WAGON)
    with pytest.raises(DataError, match=r"nothere\.safetensors: no such file"):
        nerfdiff.load_scene("nothere.safetensors")
    with pytest.raises(AttributeError, match="no attribute 'lode'"):
        nerfdiff.lode  # noqa: B018
