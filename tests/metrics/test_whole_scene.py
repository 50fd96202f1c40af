import csv
import json
from pathlib import Path

import hydra
import pytest
import torch
from omegaconf import OmegaConf
from solid_scene import FAR, NEAR, pictures, ring

from nerfdiff.cameras import Cameras
from nerfdiff.data.scene import Scene
from nerfdiff.field.decoder import Decoder
from nerfdiff.field.triplane import Triplane
from nerfdiff.fit.refined_field import RefinedField
from nerfdiff.fit.saved_field import FIELD, SavedField, load_field, save_field
from nerfdiff.metrics.geometry import depth_extent, floaters
from nerfdiff.metrics.predictions import PredictionWriter
from nerfdiff.metrics.score import truth_from
from nerfdiff.render.renderer import Renderer
from nerfdiff.results.row import ResultRow
from nerfdiff.results.table import markdown
from nerfdiff.utils.errors import DataError
from nerfdiff.utils.randomness import generator

CONFIG = Path(__file__).parents[2] / "conf" / "metrics" / "default.yaml"
SIZE, VIEWS = 16, 7
NAMES = tuple(f"{k:06d}" for k in range(VIEWS))


def moved(cameras: Cameras) -> Cameras:
    """The same cameras in a world of another origin and other axes."""
    turn = torch.tensor([[0.0, 0, 1, 4], [1, 0, 0, -2], [0, 1, 0, 3], [0, 0, 0, 1]])
    return Cameras(turn @ cameras.c2w, cameras.K, cameras.height, cameras.width)


class Reader:
    """Balls, whose world is not that of the input camera (view 0)."""

    identity, nearest_view = "balls", False

    def __init__(self, ids, depth=True, mask=True):
        self.ids, self.known = ids, (depth, mask)

    def __len__(self):
        return len(self.ids)

    def fingerprint(self):
        return str(self.ids)

    def scene_id(self, index):
        return self.ids[index]

    def view_names(self, index):
        return NAMES

    def listing(self, index):
        raise NotImplementedError

    def load(self, index, views=None, truth=False):
        views = list(range(VIEWS) if views is None else views)
        cameras = ring(VIEWS, SIZE)
        pixels, depth = pictures(cameras)
        has_depth, has_mask = self.known
        return Scene(
            self.ids[index],
            tuple(NAMES[view] for view in views),
            pixels[views],
            moved(cameras)[views],
            NEAR,
            FAR,
            mask=depth[views] > 0 if has_mask and truth else None,
            depth=depth[views] if has_depth and truth else None,
        )


def saved_field(background: float | None = 1.0) -> SavedField:
    """A fog that fills the input camera's frustum."""
    torch.manual_seed(0)
    triplane = Triplane(torch.randn(1, 3, 4, 8, 8), ring(1, SIZE), torch.tensor([NEAR]), torch.tensor([FAR]))
    field = RefinedField(triplane, Decoder(4, 8, 0.0, 1.0))
    return SavedField(field, Renderer(8, 8, background, 10**6))


def scorer(**changes):
    without = {"lpips": False, "st_lpips": False, "fid": False}
    small = {"background": 1.0, "steps": 3, "rays": 32, "plane_size": 8, "channels": 4}
    return hydra.utils.instantiate(OmegaConf.merge(OmegaConf.load(CONFIG), without, {"consistency": small | changes}))


@pytest.fixture
def folder(tmp_path):
    """Scenes a (with depth and a field) and b (colours alone), predicted rightly."""
    pixels, depth = (values[1:] for values in pictures(ring(VIEWS, SIZE)))
    writer = PredictionWriter(tmp_path, "ngd", ("a", "b"), {})
    images = pixels.float() / 255
    writer.write("a", NAMES[1:], images, NAMES[:1], 0.5 * depth, (depth > 0).float())
    writer.write("b", NAMES[1:], images, NAMES[:1])
    save_field(tmp_path / "ngd" / "a" / FIELD, saved_field())
    return tmp_path / "ngd"


def score(folder, reader=None, **changes):
    return scorer(**changes).score(folder, truth_from(reader or Reader(["a", "b"])), folder.parent / "scores")


def test_geometry_is_measured_in_the_space_of_the_input_camera(folder):
    """The dataset's world is turned and shifted; the reference never leaves the input camera's."""
    summary = score(folder)
    cameras = ring(VIEWS, SIZE)[1:]
    depth = pictures(cameras)[1]
    saved = load_field(folder / "a" / FIELD)
    draws = generator("cpu", 0, "floaters", "a")
    expected = floaters(saved.field.field(), saved.renderer, cameras, depth > 0, NEAR, FAR, 16384, 1, 1e-4, draws)
    assert 0.3 < expected < 1
    assert summary["floaters"] == pytest.approx(expected, abs=1e-3)
    # half as deep in every view's own z: in the input camera's space, but in no other, this is its extent
    expected = depth_extent(0.5 * depth, (depth > 0).float(), depth, cameras, 0.5, 0.05)
    assert summary["depth_extent"] == pytest.approx(expected, abs=1e-4)


def test_whole_scenes_have_rows_and_means(folder):
    summary = score(folder, scenes=1)
    with open(folder.parent / "scores" / "per_scene.csv", newline="") as file:
        a, b = csv.DictReader(file)
    assert float(a["floaters"]) == pytest.approx(summary["floaters"], rel=1e-6)
    assert float(a["consistency_psnr"]) == pytest.approx(summary["consistency_psnr"], rel=1e-6)
    assert a["consistency_psnr_truth"] == a["consistency_psnr"]  # predicted rightly, and fitted alike
    assert b["floaters"] == b["depth_extent"] == b["consistency_psnr"] == b["consistency_psnr_truth"] == ""
    assert summary["consistency_n"] == 1 and summary["sharpness"] == pytest.approx(1)
    table = markdown([ResultRow(run_id="r", **summary)])
    for heading in ("sharpness † (1)", "floaters ↓", "depth extent (1)", "consistency PSNR † ↑"):
        assert heading in table
    assert json.loads((folder.parent / "scores" / "summary.json").read_text()) == summary


def test_consistency_is_of_all_scenes_or_of_none(folder):
    assert score(folder)["consistency_n"] is None
    assert score(folder, scenes=None)["consistency_n"] == 2


def test_a_hull_needs_silhouettes(folder):
    by_mask = score(folder, Reader(["a", "b"], depth=False))
    assert by_mask["floaters"] == pytest.approx(score(folder)["floaters"]) and by_mask["depth_extent"] is None
    assert score(folder, Reader(["a", "b"], depth=False, mask=False))["floaters"] is None
    save_field(folder / "a" / FIELD, saved_field(background=None))  # a scene that goes on to the horizon
    assert score(folder)["floaters"] is None


def test_a_damaged_field_is_named(folder):
    (folder / "a" / FIELD).write_bytes(b"nonsense")
    with pytest.raises(DataError, match=r"a/field\.safetensors"):
        score(folder)
