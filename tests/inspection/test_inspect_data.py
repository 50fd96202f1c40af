"""The whole command on small datasets: what it writes, prints, and how it ends."""

import io
import json
import re
from pathlib import Path

import numpy as np
import pytest
from hydra.utils import instantiate
from PIL import Image
from rich.console import Console
from solids import HEIGHT, WIDTH, write_solids

from nerfdiff.cli import load_config
from nerfdiff.inspection.bounds_plot import Distances, write_bounds_plot
from nerfdiff.inspection.inspect import inspect_data
from nerfdiff.inspection.report import markdown, print_report
from nerfdiff.inspection.summary import SplitSummary, summarise_split
from nerfdiff.inspection.survey import Sample, sampled, survey_split
from nerfdiff.utils.errors import DataError
from posed_fixtures import CENTRE, write_nerfstudio

SPLITS = {"train": 3, "test": 2}
SMALL = ["sample.scenes=2", "sample.views=8", "data.source_view=7", "camera_plot.dpi=40", "bounds_plot.dpi=40"]


def run(root: Path, out: Path, *overrides: str):
    cfg = load_config("inspect_data", [*SMALL, f"data.root={root}", f"paths.output_dir={out}", *overrides])
    return {summary.stage: summary for summary in inspect_data(cfg)}


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    root = tmp_path_factory.mktemp("good")
    write_solids(root, SPLITS, truth=True)
    return root


@pytest.fixture(scope="module")
def inspected(good, tmp_path_factory):
    out = tmp_path_factory.mktemp("inspected")
    return run(good, out), out


def test_the_numbers_of_a_dataset(inspected):
    splits, _ = inspected
    train, val, test = splits["train"], splits["val"], splits["test"]
    assert "no val split" in val.absent and not val.failures
    assert (train.scenes, train.scenes_read, train.images_read) == (3, 2, 16)
    assert (train.views.low, train.views.high) == (10, 10)
    assert (train.compared, test.compared) == (2, 2) and train.focal_told
    assert train.sizes == {f"{HEIGHT} x {WIDTH}": 2}
    assert (train.focal.low, train.near.median, train.far.median) == (62.0, 0.8, 1.8)
    assert (test.masks, test.depths) == (2, 2)
    assert {found.check: found.status for found in test.checks} == {
        **dict.fromkeys(["stray_cameras", "intrinsics", "poses", "optical_axes", "bounds", "depth"], "ok"),
        **dict.fromkeys(["silhouettes", "images", "masks"], "ok"),
        "matches": "not checked",
    }


def test_what_is_written_is_whole(inspected):
    splits, out = inspected
    names = {f"{stage}_{what}.png" for stage in SPLITS for what in ("cameras", "bounds", "sheet")}
    assert {path.name for path in out.iterdir()} == names | {"report.md", "report.json"}
    for name in names:
        with Image.open(out / name) as picture:
            assert np.asarray(picture.convert("L")).std() > 3  # something is drawn
    report = json.loads((out / "report.json").read_text())
    assert report["status"] == "ok"
    assert report["splits"][0]["checks"][4]["median"] == splits["train"].checks[4].median
    text = (out / "report.md").read_text()
    assert all(f"]({name})" in text for name in names) and "no val split" in text


def test_the_input_view_is_marked_and_read(inspected):
    """View 7 is not among 8 of 10 views spread evenly, but it is the test's input."""
    splits, out = inspected
    assert splits["test"].images_read == 2 * 8 + 2
    sheet = np.asarray(Image.open(out / "test_sheet.png")).astype(int)
    red = (np.abs(sheet - [217, 26, 26]).max(-1) < 6).any(0)
    columns = np.flatnonzero(red)
    assert columns.size and columns.max() < 0.3 * sheet.shape[1]  # in the first column only
    assert not (np.abs(np.asarray(Image.open(out / "train_sheet.png")).astype(int) - [217, 26, 26]).max(-1) < 6).any()


def test_the_sample_depends_on_the_seed_and_the_split():
    assert sampled(1000, 5, "0/train") == sampled(1000, 5, "0/train")
    assert len({tuple(sampled(1000, 5, key)) for key in ("0/train", "1/train", "0/test")}) == 3
    assert sampled(4, None, "0") == sampled(4, 9, "0") == [0, 1, 2, 3]
    drawn = sampled(1000, 400, "0")
    assert drawn == sorted(set(drawn)) and len(drawn) == 400 and drawn[0] < 20 and drawn[-1] > 980


def test_wrong_axes_end_in_an_error_that_names_the_misreading(tmp_path, capsys):
    write_solids(tmp_path / "data", {"train": 1}, change=lambda pose: pose @ np.diag([1.0, -1, -1, 1]))
    with pytest.raises(DataError, match=r"train: optical_axes failed, silhouettes failed; see .*report\.md"):
        run(tmp_path / "data", tmp_path / "out")
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["status"] == "failed"
    assert report["splits"][0]["explanations"] == ["the camera axes are OpenGL's (y up, z backward), not OpenCV's"]
    assert "every check of the cameras would pass if the camera axes are OpenGL's" in capsys.readouterr().out


def test_bad_scenes_are_listed_and_the_others_read(tmp_path):
    write_solids(tmp_path / "data", {"train": 3})
    scene = tmp_path / "data" / "cars_train"
    (scene / "scene0" / "pose" / "000003.txt").write_text("1 2 3")
    (scene / "scene2" / "pose" / "000001.txt").unlink()
    with pytest.raises(DataError, match="train: 2 bad scenes; see"):
        run(tmp_path / "data", tmp_path / "out", "sample.scenes=null", "sample.views=null")
    train = json.loads((tmp_path / "out" / "report.json").read_text())["splits"][0]
    assert "000003.txt" in train["bad"]["scene0"] and "poses without" not in train["bad"]["scene0"]
    assert "do not match by name" in train["bad"]["scene2"]
    assert (train["scenes"], train["scenes_read"]) == (3, 1)


def test_what_cannot_be_checked_is_said(tmp_path, capsys):
    write_solids(tmp_path / "data", {"train": 1}, views=4)
    said = "cameras unchecked: there is no depth, silhouette or texture"
    with pytest.raises(DataError, match="train: cameras unchecked; see"):
        run(tmp_path / "data", tmp_path / "out", "data.background=null")
    out, report = capsys.readouterr().out, (tmp_path / "out" / "report.md").read_text()
    assert f"train: {said}" in out and said in report and "allow_unchecked=true" in out
    train = summary_of(tmp_path / "data", "data.background=null", "allow_unchecked=true")
    assert not train.compared and not train.failures
    assert said in markdown("", [train]) and "allow_unchecked" not in markdown("", [train])


def summary_of(root: Path, *overrides: str) -> SplitSummary:
    """Of the training split, without pictures, which take most of the time."""
    cfg = load_config("inspect_data", [*SMALL, f"data.root={root}", *overrides])
    checks = {name: instantiate(check) for name, check in cfg.checks.items() if check is not None}
    strays, sample = instantiate(cfg.stray_cameras), Sample(cfg.sample.scenes, cfg.sample.views, 8, 0, 0, 0)
    reader = instantiate(cfg.data).reader("train")
    survey = survey_split("train", "train", reader, None, sample, checks, strays, lambda: None)
    return summarise_split(survey, checks, strays, {}, cfg.allow_unchecked)


def test_what_silhouettes_do_not_tell_is_said(tmp_path):
    write_solids(tmp_path, {"train": 1})
    found = summary_of(tmp_path)
    assert found.compared and not found.focal_told and not found.failures
    assert "focal length unchecked: silhouettes hardly change with it" in markdown("", [found])


def twenty_times_as_far(folder: Path) -> None:
    content = json.loads((folder / "transforms.json").read_text())
    for row, centre in zip(content["frames"][1]["transform_matrix"], CENTRE, strict=False):
        row[3] = centre + 20 * (row[3] - centre)
    (folder / "transforms.json").write_text(json.dumps(content))


# of five points there are no silhouettes
FEW_OF_TEN = [
    "data=posed_images", "sample.views=2", "data.image_size=null", "data.source_view=0",
    "checks.silhouettes=null", "checks.matches=null", "allow_unchecked=true",
]  # fmt: skip


@pytest.mark.parametrize("missing", ["images/frame_00002.png", "masks/frame_00002.png"])
def test_a_file_missing_outside_the_sample_is_named(tmp_path, missing):
    """Case 04: it was found by training."""
    write_nerfstudio(tmp_path, views=10)
    (tmp_path / missing).unlink()
    with pytest.raises(DataError, match=rf"1 of 10 listed images or their masks are not there: {missing}"):
        summary_of(tmp_path, *FEW_OF_TEN)


def test_a_stray_camera_outside_the_sample_is_named(tmp_path):
    """Case 05: it set everyone's bounds."""
    write_nerfstudio(tmp_path, views=10)
    assert not summary_of(tmp_path, *FEW_OF_TEN).failures
    twenty_times_as_far(tmp_path)
    found = summary_of(tmp_path, *FEW_OF_TEN)
    words = r"stray cameras: view frame_00002 is (19|2[01])(\.\d)? times as far .* middle one of 10 cameras"
    assert found.failures == ["stray_cameras failed"] and re.search(words, markdown("", [found]))
    assert not summary_of(tmp_path, *FEW_OF_TEN, "stray_cameras=null").failures


def test_masks_and_images_that_show_nothing_fail(tmp_path):
    """Case 02, and images that are all blank, in data whose cameras are right."""
    write_solids(tmp_path, {"train": 1}, truth=True)
    scene = tmp_path / "cars_train/scene0"
    for file in (scene / "mask").iterdir():
        Image.fromarray(255 - np.asarray(Image.open(file))).save(file)
    for file in (scene / "rgb").iterdir():
        Image.new("RGB", (WIDTH, HEIGHT), (255, 255, 255)).save(file)
    found = summary_of(tmp_path)
    assert {"images failed", "masks failed"} <= set(found.failures)
    texts = {check.check: check.text for check in found.checks}
    assert "8 of 8 images are blank" in texts["images"] and "they look inverted" in texts["masks"]


def test_a_split_without_one_readable_scene_is_still_reported(tmp_path):
    write_solids(tmp_path / "data", {"train": 1})
    (tmp_path / "data" / "cars_train" / "scene0" / "intrinsics.txt").write_text("nothing")
    with pytest.raises(DataError, match="train: 1 bad scene; see"):
        run(tmp_path / "data", tmp_path / "out")
    train = json.loads((tmp_path / "out" / "report.json").read_text())["splits"][0]
    assert {check["status"] for check in train["checks"]} == {"not checked"}
    assert train["pictures"] == {}


def test_a_test_scene_without_the_input_view_is_bad(good, tmp_path):
    with pytest.raises(DataError, match="test: 2 bad scenes"):
        run(good, tmp_path, "data.source_view=64", "checks.silhouettes=null")
    train = json.loads((tmp_path / "report.json").read_text())["splits"][0]
    assert "silhouettes" not in {check["check"] for check in train["checks"]} and len(train["checks"]) == 9


def test_a_root_that_is_not_there_is_one_error(tmp_path):
    with pytest.raises(DataError, match="no such folder; set"):
        run(tmp_path / "nowhere", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_names_of_data_are_no_markup(tmp_path):
    name = "[/bold]<b>$x^{$\x1b[2J"
    split = SplitSummary("train", "train", scenes=1, sizes={name: 1}, bad={name: name})
    absent = SplitSummary("test", "test", absent=name)
    console = Console(file=io.StringIO(), width=200)
    print_report(console, name, [split, absent], 5)
    assert "[/bold]<b>$x^{$ [2J" in console.file.getvalue() and "\x1b" not in console.file.getvalue()
    text = markdown(name, [split, absent])
    assert "<b>" not in text and "# [/bold]&lt;b>" in text and "- [/bold]&lt;b>" in text
    write_bounds_plot(tmp_path / "b.png", [Distances(np.array([1.0, 2.0]), 0.5, 3.0, "surfaces")], name, 4, 40)
