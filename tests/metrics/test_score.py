import csv
import json
import logging
import math
from dataclasses import fields
from pathlib import Path

import hydra
import no_network
import pytest
import torch
from omegaconf import OmegaConf

from nerfdiff.cameras import Cameras
from nerfdiff.data.scene import Scene
from nerfdiff.metrics.predictions import PredictionWriter
from nerfdiff.metrics.score import Scorer, truth_from
from nerfdiff.results.row import ResultRow
from nerfdiff.utils.errors import DataError

CONFIG = Path(__file__).parents[2] / "conf" / "metrics" / "default.yaml"
SIZE = 8


class Reader:
    """Scenes of grey images: view i of scene s has the level `levels[s][i]`."""

    identity, nearest_view = "grey", False

    def __init__(self, levels, depth=None, mask=None):
        self.levels, self.depth, self.mask = levels, depth, mask

    def __len__(self):
        return len(self.levels)

    def fingerprint(self):
        return str(self.levels)

    def scene_id(self, index):
        return list(self.levels)[index]

    def view_names(self, index):
        return tuple(f"{i:06d}" for i in range(len(self.levels[self.scene_id(index)])))

    def listing(self, index):
        raise NotImplementedError

    def load(self, index, views=None, truth=False):
        levels = torch.tensor(self.levels[self.scene_id(index)], dtype=torch.uint8)
        views = list(range(len(levels)) if views is None else views)
        n = len(views)
        cameras = Cameras(torch.eye(4).expand(n, 4, 4), torch.eye(3).expand(n, 3, 3), SIZE, SIZE)
        pixels = levels[views][:, None, None, None].expand(n, 3, SIZE, SIZE)
        names = tuple(self.view_names(index)[i] for i in views)
        extra = {} if self.depth is None else {"depth": self.depth.expand(n, -1, -1)}
        extra |= {} if self.mask is None else {"mask": self.mask.expand(n, -1, -1)}
        return Scene(self.scene_id(index), names, pixels, cameras, 0.5, 2.0, **(extra if truth else {}))


def grey(*levels):
    return (torch.tensor(levels)[:, None, None, None] / 255).expand(-1, 3, SIZE, SIZE)


def config(**changes):
    without = {"lpips": False, "st_lpips": False, "fid": False, "consistency": {"background": 1.0}}
    return OmegaConf.merge(OmegaConf.load(CONFIG), without, changes)


def scorer(**changes):
    return hydra.utils.instantiate(config(**changes))


def decibels(offset):
    return -10 * math.log10(max((offset / 255) ** 2, 1e-6))


def rows(path):
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


@pytest.fixture
def three_scenes(tmp_path):
    """a: views 1 and 3, off by 51 and 0 levels; b: one view, off by 102; w: white, off by 0."""
    reader = Reader({"b": [100, 0], "a": [9, 100, 9, 200], "w": [255, 255]})
    writer = PredictionWriter(tmp_path / "predictions", "none", ("a", "b", "w"), {})
    writer.write("a", ("000001", "000003"), grey(151, 200))
    writer.write("b", ("000001",), grey(102))
    writer.write("w", ("000000",), grey(255))
    return tmp_path, reader


def test_known_numbers(three_scenes):
    tmp_path, reader = three_scenes
    summary = scorer().score(tmp_path / "predictions" / "none", truth_from(reader), tmp_path / "scores")
    a, b, w = (decibels(51) + 60) / 2, decibels(102), 60
    assert summary["psnr"] == pytest.approx((a + b + w) / 3, abs=1e-4)
    assert summary["psnr_without_blank"] == pytest.approx((a + b) / 2, abs=1e-4)
    assert (summary["n_scenes"], summary["n_views"], summary["blank_scenes"]) == (3, 4, 1)
    per_image = rows(tmp_path / "scores" / "per_image.csv")
    assert [(r["scene"], r["view"]) for r in per_image] == [
        ("a", "000001"),
        ("a", "000003"),
        ("b", "000001"),
        ("w", "000000"),
    ]
    psnrs = [float(r["psnr"]) for r in per_image]
    assert psnrs == pytest.approx([decibels(51), 60, decibels(102), 60], abs=1e-4)
    per_scene = rows(tmp_path / "scores" / "per_scene.csv")
    assert [(r["scene"], r["views"], r["blank"]) for r in per_scene] == [
        ("a", "2", "0"),
        ("b", "1", "0"),
        ("w", "1", "1"),
    ]
    assert [float(r["psnr"]) for r in per_scene] == pytest.approx([a, b, w], abs=1e-4)
    assert json.loads((tmp_path / "scores" / "summary.json").read_text()) == summary


def test_what_is_not_measured_is_empty(three_scenes):
    tmp_path, reader = three_scenes
    summary = scorer().score(tmp_path / "predictions" / "none", truth_from(reader), tmp_path / "scores")
    networks = ("lpips", "lpips_net", "st_lpips_vgg", "fid", "fd_st_vgg", "fid_n")
    whole = ("floaters", "depth_extent", "consistency_psnr", "consistency_psnr_truth", "consistency_n")
    for metric in (*networks, "sharpness", "depth_rmse", "mask_iou", *whole):
        assert summary[metric] is None
    for row in rows(tmp_path / "scores" / "per_image.csv"):
        assert row["lpips"] == row["st_lpips_vgg"] == row["depth_rmse"] == row["ssim_gaussian"] == ""


def test_without_blank_scenes_there_is_no_second_mean(tmp_path):
    PredictionWriter(tmp_path, "none", ("a",), {}).write("a", ("000000",), grey(10))
    summary = scorer().score(tmp_path / "none", truth_from(Reader({"a": [20]})), tmp_path / "scores")
    assert summary["blank_scenes"] == 0 and "psnr_without_blank" not in summary


def test_scores_do_not_depend_on_the_batch(three_scenes):
    tmp_path, reader = three_scenes
    folder, truth = tmp_path / "predictions" / "none", truth_from(reader)
    one, all_ = (scorer(st_lpips=True, batch=b).score(folder, truth, tmp_path / str(b)) for b in (1, 99))
    assert one.keys() == all_.keys()
    for key, value in all_.items():
        expected = pytest.approx(value, rel=1e-4, abs=1e-6) if isinstance(value, float) else value
        assert one[key] == expected, key
    assert all_["fid_n"] == 4 and all_["fd_st_vgg"] > 0 and all_["st_lpips_vgg"] > 0
    assert all_["st_lpips_vgg_without_blank"] > all_["st_lpips_vgg"]


def test_missing_weights_leave_columns_empty_and_nothing_is_fetched(three_scenes, monkeypatch, caplog):
    tmp_path, reader = three_scenes
    no_network.block(monkeypatch)
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path / "hub"))
    with caplog.at_level(logging.WARNING):
        summary = scorer(lpips=True, fid=True).score(
            tmp_path / "predictions" / "none", truth_from(reader), tmp_path / "scores"
        )
    assert summary["lpips"] is None and summary["fid"] is None and summary["psnr"] is not None
    assert [record.getMessage().split(" ")[0] for record in caplog.records] == ["lpips", "fid"]


def test_geometry_where_truth_and_prediction_have_it(tmp_path):
    true_depth = torch.zeros(1, SIZE, SIZE)
    true_depth[:, :4] = 2.0
    opacity = torch.zeros(1, SIZE, SIZE)
    opacity[:, 2:4] = 1.0
    writer = PredictionWriter(tmp_path, "none", ("a", "b"), {})
    writer.write("a", ("000000",), grey(20), (), torch.full((1, SIZE, SIZE), 2.5), opacity)
    writer.write("b", ("000000",), grey(20))
    reader = Reader({"a": [20], "b": [20]}, depth=true_depth)
    summary = scorer().score(tmp_path / "none", truth_from(reader), tmp_path / "scores")
    assert summary["depth_abs_rel"] == pytest.approx(0.25)
    assert summary["depth_rmse"] == pytest.approx(0.5)
    assert summary["mask_iou"] == pytest.approx(0.5)
    per_scene = rows(tmp_path / "scores" / "per_scene.csv")
    assert per_scene[0]["depth_rmse"] == "0.5" and per_scene[1]["depth_rmse"] == ""
    reader.mask = torch.ones(1, SIZE, SIZE, dtype=torch.bool)
    summary = scorer().score(tmp_path / "none", truth_from(reader), tmp_path / "scores")
    assert summary["mask_iou"] == pytest.approx(0.25)


def test_an_unfinished_evaluation_is_not_scored(three_scenes):
    tmp_path, reader = three_scenes
    (tmp_path / "predictions" / "none" / "b" / "scene.json").unlink()
    with pytest.raises(DataError, match="1 of 3 scenes are not predicted yet, first b"):
        scorer().score(tmp_path / "predictions" / "none", truth_from(reader), tmp_path / "scores")


def test_predictions_that_do_not_fit_the_dataset_are_refused(three_scenes):
    tmp_path, reader = three_scenes
    folder = tmp_path / "predictions" / "none"
    with pytest.raises(DataError, match="scene 'a' is not in the dataset grey"):
        scorer().score(folder, truth_from(Reader({"b": [1, 2]})), tmp_path / "scores")
    with pytest.raises(DataError, match="no view '000003'"):
        scorer().score(folder, truth_from(Reader(reader.levels | {"a": [1, 2]})), tmp_path / "scores")
    PredictionWriter(tmp_path, "small", ("b",), {}).write("b", ("000000",), grey(1)[:, :, 1:])
    with pytest.raises(DataError, match=r"scene b: predicted 1 views of shape \(3, 7, 8\)"):
        scorer().score(tmp_path / "small", truth_from(reader), tmp_path / "scores")


def test_every_summary_fits_a_result_row(three_scenes):
    tmp_path, reader = three_scenes
    measure = scorer(ssim_gaussian=True)
    summary = measure.score(tmp_path / "predictions" / "none", truth_from(reader), tmp_path / "scores")
    assert summary.keys() <= {field.name for field in fields(ResultRow)}
    assert ResultRow(run_id="x", **summary).ssim_gaussian == summary["ssim_gaussian"] > 0


def test_config_keys_are_those_of_the_scorer():
    with pytest.raises(hydra.errors.InstantiationException, match="psnr_flor"):
        scorer(psnr_flor=1)
    assert scorer(psnr_floor=1e-3).psnr_floor == 1e-3
    assert isinstance(scorer(), Scorer)
