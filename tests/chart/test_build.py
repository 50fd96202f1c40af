import csv
import json
import os
import re
import struct
import sys
import zlib
from pathlib import Path

import numpy as np
import pytest
import yaml
from PIL import Image

from chart_fixtures import FRONTIERS, KNOWN, chart, failed, result, timing, write_results, write_sheet
from nerfdiff.chart.build import build_chart
from nerfdiff.chart.published import LITERATURE
from nerfdiff.cli import load_config
from nerfdiff.utils.errors import ConfigError, DataError


def content(page: Path) -> dict:
    """What the page knows."""
    return json.loads(re.search(r'<script type="application/json" id="data">(.*?)</script>', page.read_text(), re.S)[1])


def ids(known: dict, numbers: list[int]) -> list[str]:
    return [known["configurations"][number]["runs"][0]["id"].rpartition("-")[0] for number in numbers]


def read_csv(path: Path) -> list[dict[str, str]]:
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def test_the_frontiers_are_the_true_ones(tmp_path):
    known = content(chart(write_results(tmp_path, *(result(name) for name in KNOWN))))
    (panel,) = known["panels"]
    for metric, names in FRONTIERS.items():
        assert ids(known, panel["frontiers"][metric]["scene_s"]) == names
    assert ids(known, panel["frontiers"]["psnr"]["params"]) == ["best"]
    assert "encode_s" not in panel["frontiers"]["psnr"]  # nobody measured it


def test_devices_and_test_images_never_share_a_frontier(tmp_path):
    fast = result("worse", device="Fast GPU", scene_s=timing(0.1))
    large = result("worse", image_size=[64, 64], scene_s=timing(0.1))
    other = result("worse", split_sha256="abc", scene_s=timing(0.1))
    known = content(chart(write_results(tmp_path, *(result(name) for name in KNOWN), fast, large, other)))
    panels = {(panel["device"], panel["test"]): panel for panel in known["panels"]}
    small = "srn_cars/test, 32×32 pixels, 3 scenes, 12 views"
    assert set(panels) == {
        ("Test CPU", f"{small}, split f00"),
        ("Fast GPU", f"{small}, split f00"),
        ("Test CPU", f"{small}, split abc"),
        ("Test CPU", "srn_cars/test, 64×64 pixels, 3 scenes, 12 views"),
    }
    assert ids(known, panels["Test CPU", f"{small}, split f00"]["frontiers"]["psnr"]["scene_s"]) == FRONTIERS["psnr"]
    assert len(panels["Fast GPU", f"{small}, split f00"]["members"]) == 1


def test_units_are_the_pages(tmp_path):
    row = result(peak_mem_bytes=3 * 2**30, field_queries=6_000_000, denoiser_calls=24)
    values = content(chart(write_results(tmp_path, row)))["configurations"][0]["values"]
    assert values["peak_mem_bytes"] == [3.0]
    assert values["field_queries"] == [2.0]  # millions, per scene
    assert values["denoiser_calls"] == [8.0]
    assert values["scene_s"] == [8.0, 7.6, 8.4]  # of an interquartile range of 0.8


def test_the_page_says_what_its_intervals_are(tmp_path):
    words = content(chart(write_results(tmp_path, result())))["how"]
    assert "95% bootstrap intervals of the difference to none" in words and "fewer than 6 scenes" in words


def test_tables_and_pictures_lie_beside_the_page(tmp_path):
    rows = [*(result(name) for name in KNOWN), failed("slow", 1)]
    page = build_chart(load_config("chart", [f"results={write_results(tmp_path / 'runs', *rows)}"]))
    assert page == tmp_path / "runs" / "chart" / "index.html"
    lines = read_csv(page.parent / "configurations.csv")
    assert [float(line["psnr"]) for line in lines] == [known[2] for known in KNOWN.values()]
    assert [line["failed"] for line in lines] == ["0", "0", "0", "1", "0"]
    assert [line["status"] for line in read_csv(page.parent / "runs.csv")] == ["ok"] * 5 + ["oom"]
    assert {path.name for path in page.parent.glob("*.png")} == {"psnr-scene_s.png", "st_lpips_vgg-scene_s.png"}
    with Image.open(page.parent / "psnr-scene_s.png") as image:
        assert image.size == (1080, 660 + 3 * 0.16 * 120 // 1)  # and a line for each of the frontier
    pngs = chart(tmp_path / "runs", out=str(tmp_path / "other"), png__costs=["denoiser_calls"]).parent.glob("*.png")
    assert {path.name for path in pngs} == {"psnr-denoiser_calls.png", "st_lpips_vgg-denoiser_calls.png"}


def test_pictures_are_found_and_small_ones_carried_along(tmp_path):
    first, second = result(folder="run a#1"), result("best", folder="run2")
    write_sheet(tmp_path / "run a#1")
    write_sheet(tmp_path / "run2")
    for scene in ("000", "001"):
        orbit = tmp_path / "run2" / "predictions" / "sds" / scene / "orbit.mp4"
        orbit.parent.mkdir(parents=True)
        orbit.touch()
    write_results(tmp_path, first, second, result("slow", folder="gone"))
    one, two, three = content(chart(tmp_path))["configurations"]
    assert (one["runs"][0]["sheet"], one["runs"][0]["folder"]) == ("../run%20a%231/sheet.png", "../run%20a%231")
    assert two["runs"][0]["orbit"] == "../run2/predictions/sds/000/orbit.mp4"
    assert "orbit" not in one["runs"][0] and "sheet" not in three["runs"][0] and three["small"] is None
    assert one["small"].startswith("data:image/webp;base64,")
    # one is more than so little: the other is a link alone
    few = content(chart(tmp_path, pictures__megabytes=0.01))["configurations"]
    assert [entry["small"] for entry in few] == [None] * 3
    smaller = content(chart(tmp_path, pictures__width=64))["configurations"][0]["small"]
    assert len(smaller) < len(one["small"]) / 4


def test_configurations_are_called_by_what_tells_them_apart(tmp_path):
    known = content(chart(write_results(tmp_path, *(result(name) for name in KNOWN))))
    assert [entry["labels"] for entry in known["configurations"]] == [
        {"strategy": strategy, "inner_steps": str(2**n)} for n, (strategy, *_) in enumerate(KNOWN.values())
    ]
    settings = [("cheap", None, "torch"), ("good", 25, "torch"), ("slow", 25, "triton")]
    rows = [
        result(name, overrides=[f"a.steps={n}", f"b.steps={n % 2}"], K=K, backend=backend)
        for n, (name, K, backend) in enumerate(settings)
    ]
    entries = content(chart(write_results(tmp_path / "x", *rows)))["configurations"]
    # K is what the strategies that have it have alike; steps of two kinds are told apart
    assert [entry["labels"] for entry in entries] == [
        {"strategy": "none", "a.steps": "0", "b.steps": "0", "backend": "torch"},
        {"strategy": "ngd", "a.steps": "1", "b.steps": "1", "backend": "torch"},
        {"strategy": "ngd", "a.steps": "2", "b.steps": "0", "backend": "triton"},
    ]


def sweep(name: str, constants: tuple[str, ...], *varied: str, **values):
    return result(name, overrides=[f"strategy={KNOWN[name][0]}", *varied, *constants], **values)


def test_names_have_no_constants_of_a_sweep_nor_places_and_nothing_twice(tmp_path):
    constants = ("sweep=speed_accuracy", "budget=minutes", "ckpt=runs/base", "data.cache_dir=data/cache", "threads=1")
    rows = [
        sweep(
            name, constants, f"precision={precision}", f"uniform_samples={n}", f"importance_samples={n}",
            "backend=auto", f"budget.views={views}", f"strategy.teacher.sampler={sampler}", precision=precision,
            samples_per_ray=2 * n, field="triplane", model="tiny", K=views, backend="cpu", run_id=f"{name}-{precision}",
        )
        for name, precision, n, views, sampler in (
            ("good", "32-true", 6, 5, "ddim"), ("slow", "bf16-mixed", 6, 10, "ddim"),
            ("worse", "bf16-mixed", 12, 10, "dpmpp_2m"),
        )
    ]  # fmt: skip
    other = ("ckpt=runs/pixelnerf", "run_name=pixelnerf", "results=runs/fields/results.jsonl")
    rows += [
        sweep("cheap", other, field="pixelnerf", model="other", precision="32-true", samples_per_ray=24, backend="cpu"),
        sweep("cheap", ("ckpt=demo",), field="triplane", model="tiny", precision="32-true", backend="cpu", run_id="x"),
    ]
    entries = content(chart(write_results(tmp_path, *rows)))["configurations"]
    assert [entry["labels"] for entry in entries[:4]] == [
        {"strategy": "ngd", "views": "5", "ckpt": "base", "importance_samples": "6", "sampler": "ddim",
         "uniform_samples": "6", "precision": "32-true"},
        {"strategy": "ngd", "views": "10", "ckpt": "base", "importance_samples": "6", "sampler": "ddim",
         "uniform_samples": "6", "precision": "bf16-mixed"},
        {"strategy": "direct", "views": "10", "ckpt": "base", "importance_samples": "12", "sampler": "dpmpp_2m",
         "uniform_samples": "12", "precision": "bf16-mixed"},
        {"strategy": "none", "ckpt": "pixelnerf", "precision": "32-true"},
    ]  # fmt: skip
    names = ["ngd views=5", "ngd views=10", "direct", "none ckpt=pixelnerf", "none ckpt=demo"]
    assert [entry["name"] for entry in entries] == names


@pytest.mark.parametrize(
    ("settings", "names"),
    [
        ([["a.x=1"], []], ["ngd x=1", "ngd"]),  # an override that others lack
        ([["threads=1"], ["threads=2"]], ["ngd threads=1", "ngd threads=2"]),  # of those not named otherwise
        ([["precision=auto"], ["precision=32-true"], []], ["ngd precision=auto", "ngd precision=32-true", "ngd"]),
        ([["ckpt=a/x/last.ckpt"], ["ckpt=b/x/last.ckpt"]], ["ngd ckpt=a/x/last.ckpt", "ngd ckpt=b/x/last.ckpt"]),
        ([None, None], ["ngd run_id=0", "ngd run_id=1"]),
    ],
)
def test_what_differs_in_little_is_told_apart_by_it(tmp_path, settings, names):
    rows = [result(overrides=words, run_id=str(number), precision="32-true") for number, words in enumerate(settings)]
    assert [entry["name"] for entry in content(chart(write_results(tmp_path, *rows)))["configurations"]] == names


def test_names_are_as_many_as_configurations(tmp_path):
    rng = np.random.default_rng(0)
    settings = {tuple(f"{key}={rng.integers(4)}" for key in "abcdefgh" if rng.random() < 0.7) for _ in range(150)}
    rows = [result(overrides=list(words), run_id=str(number)) for number, words in enumerate(sorted(settings))]
    names = [entry["name"] for entry in content(chart(write_results(tmp_path, *rows)))["configurations"]]
    assert len(set(names)) == len(settings)


def test_failed_runs_are_told_and_keep_their_reason(tmp_path):
    known = content(chart(write_results(tmp_path, result(), failed("slow", 4, status="nan", error="rgb of <b>"))))
    (entry,) = known["failures"]
    assert (entry["status"], entry["error"], entry["seed"]) == ("nan", "rgb of <b>", 4)
    assert "strategy=ngd" in [known["words"][number] for number in entry["overrides"]]
    assert entry["command"].startswith("python src/distill.py seed=4")


def test_published_values_stand_with_their_source_beside_the_dataset_they_are_of(tmp_path):
    cars, chairs = result(), result(dataset="srn_chairs/test", image_size=[128, 128])
    known = content(chart(write_results(tmp_path, cars, chairs, result(dataset="posed_images/test"))))
    assert len(known["configurations"]) == 3
    by_test = {panel["test"].split(",")[0]: panel["published"] for panel in known["panels"]}
    assert by_test["posed_images/test"] == []
    cars = {entry["method"]: entry for entry in by_test["srn_cars/test"]}
    assert cars["NerfDiff-B"]["metrics"] == {"psnr": 23.51, "ssim": 0.92, "lpips": 0.082, "fid": 18.09}
    # four views to a scene
    assert cars["pixelNeRF"]["costs"]["scene_s"] == pytest.approx(0.007 + 4 * 1.639)
    assert "GPU not named" in cars["pixelNeRF"]["source"] and cars["SRN"]["costs"] == {}
    assert not cars["SRN"]["same_size"] and all(entry["same_size"] for entry in by_test["srn_chairs/test"])
    assert {entry["source"] for entry in by_test["srn_chairs/test"]} and len(by_test["srn_chairs/test"]) == 14


ENTRY = {"method": "X", "dataset": "srn_cars", "image_size": 1, "psnr": 1.0, "source": "nobody"}
SPEED = {"encode_s": 1.0, "render_s": 1.0, "source": "ssdnerf"}


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"values": [ENTRY], "speeds": {}}, "published.values: X: source 'nobody'"),
        ({"speeds": {"SRN": SPEED | {"source": "?"}}}, "published.speeds: SRN: source"),
        ({"speeds": {"Nobody": SPEED}}, "published.speeds: .* Nobody"),
        ({"speeds": 3}, "papers.yaml: expected sources, speeds and values"),
        ({"more": {}}, "papers.yaml: expected sources, speeds and values"),
    ],
)
def test_what_is_wrong_in_published_values_is_named(tmp_path, settings, words):
    papers = tmp_path / "papers.yaml"
    papers.write_text(yaml.safe_dump(yaml.safe_load(LITERATURE.read_text()) | settings))
    with pytest.raises(ConfigError, match=words):
        chart(write_results(tmp_path, result()), published=str(papers))


@pytest.mark.parametrize(
    ("content", "words"), [(None, "No such file"), (b"a: [", "while parsing"), (b"\xff", "decode")]
)
def test_a_file_of_published_values_that_cannot_be_read_is_named(tmp_path, content, words):
    if content is not None:
        (tmp_path / "papers.yaml").write_bytes(content)
    with pytest.raises(ConfigError, match=rf"papers.yaml cannot be read \(.*{words}"):
        chart(write_results(tmp_path, result()), published=str(tmp_path / "papers.yaml"))


def test_costs_of_pictures_that_the_page_lacks_are_named(tmp_path):
    with pytest.raises(ConfigError, match=r"png.costs: money is not among"):
        chart(write_results(tmp_path, result()), png__costs=["money"])


def test_results_of_another_schema_are_named_and_do_not_hide_the_others(tmp_path):
    write_results(tmp_path / "new", result())
    old = write_results(tmp_path / "old", result()) / "results.jsonl"
    old.write_text(re.sub(r'"schema_version": \d+', '"schema_version": 1', old.read_text()))
    known = content(chart(tmp_path))
    assert len(known["configurations"]) == 1
    (line,) = known["unread"]
    assert str(old) in line and "schema version 1" in line
    for results in (old, tmp_path / "old"):
        with pytest.raises(DataError, match="schema version 1"):
            chart(results)


def test_empty_folders_and_failures_alone_make_pages_that_say_so(tmp_path):
    known = content(chart(write_results(tmp_path / "empty")))
    assert known["panels"] == [] and "There are no results in" in known["empty"]
    known = content(chart(write_results(tmp_path / "failed", failed(), failed("slow"))))
    assert known["panels"] == [] and known["empty"].startswith("All 2 runs in") and len(known["failures"]) == 2
    with pytest.raises(DataError, match="does not exist"):
        chart(tmp_path / "nowhere")
    with pytest.raises(ConfigError, match="names nothing"):
        chart([])


@pytest.mark.parametrize("missing", ["plotly.offline", "itables"])
def test_a_missing_library_is_named_and_the_tables_are_there(tmp_path, monkeypatch, missing):
    monkeypatch.setitem(sys.modules, missing, None)
    with pytest.raises(ConfigError, match="pip install plotly itables"):
        chart(write_results(tmp_path, result("good")))
    assert list(tmp_path.rglob("configurations.csv")) and not list(tmp_path.rglob("index.html"))


def test_several_results_make_one_page(tmp_path):
    write_results(tmp_path / "a", result())
    write_results(tmp_path / "b", result("slow"))
    page = chart([tmp_path / "a" / "results.jsonl", tmp_path / "b"])
    assert page.parent == tmp_path / "a" / "chart" and len(content(page)["configurations"]) == 2
    assert len(content(chart(tmp_path))["configurations"]) == 2


def test_a_file_that_is_named_twice_is_read_once(tmp_path, monkeypatch):
    monkeypatch.chdir(write_results(tmp_path, result(), failed("slow")))
    (tmp_path / "link").symlink_to(tmp_path, target_is_directory=True)
    known = content(chart([tmp_path, ".", tmp_path / "results.jsonl", tmp_path / "link"]))
    assert known["counts"].startswith("2 runs, 1 configurations, 1 failed runs")
    assert len(known["configurations"][0]["runs"]) == 1


def test_lines_that_are_no_rows_are_told_and_cost_no_other(tmp_path):
    path = write_results(tmp_path / "a", result(), failed("slow")) / "results.jsonl"
    path.write_text('{"torn\n' + path.read_text() + "[[[\n")
    write_results(tmp_path / "b", result("best"))
    (tmp_path / "c").mkdir()
    (tmp_path / "c" / "results.jsonl").write_text("torn")
    known = content(chart(tmp_path))
    assert len(known["configurations"]) == 2 and len(known["failures"]) == 1
    skipped, left_out = known["unread"]
    assert f"{path}: 2 lines are no rows and were skipped: line 1: not JSON" in skipped
    assert left_out.startswith("left out:") and "c/results.jsonl: 1 line is no row" in left_out
    with pytest.raises(DataError, match="1 line is no row"):
        chart(tmp_path / "c")


def test_nothing_is_shown_from_outside_of_the_results(tmp_path):
    write_sheet(tmp_path / "private" / "predictions")
    write_sheet(tmp_path / "private")
    results = tmp_path / "results"
    (results / "run").mkdir(parents=True)
    (results / "run" / "sheet.png").symlink_to(tmp_path / "private" / "sheet.png")
    (results / "link").symlink_to(tmp_path / "private")
    folders = ("../private", str(tmp_path / "private"), "link", "run", "run/../../private")
    rows = [
        result(folder=folder, strategy="../..", overrides=[f"x={n}"], run_id=folder) for n, folder in enumerate(folders)
    ]
    known = content(chart(write_results(results, *rows)))
    runs = [entry["runs"][0] for entry in known["configurations"]]
    assert [entry["small"] for entry in known["configurations"]] == [None] * 5
    assert [run.get("folder") for run in runs] == [None, None, None, "../run", None]
    assert not any("sheet" in run or "orbit" in run for run in runs)
    assert [line for line in known["unread"] if line.startswith("4 of 5 runs say that their folders lie outside")]
    # both are results
    known = content(chart([results, tmp_path / "private"]))
    assert known["configurations"][0]["small"] and not known["unread"]


def png_header(width: int, height: int) -> bytes:
    """The beginning of a picture that claims to be so large."""
    size = b"IHDR" + struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    chunk = struct.pack(">I", 13) + size + struct.pack(">I", zlib.crc32(size))
    return b"\x89PNG\r\n\x1a\n" + chunk + struct.pack(">I", 999) + b"IDAT" + b"\0" * 20


@pytest.mark.parametrize(
    ("sheet", "words"),
    [
        (png_header(50_000, 50_000), "exceeds limit"),
        (png_header(13_000, 13_000), "13000×13000 pixels are more than pictures.megapixels=64"),
        (png_header(100, 100), "not shown"),
        (b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n", "cannot identify image file"),
        (b"", "cannot identify image file"),
        (None, "it is no file"),
    ],
    ids=["2.5 gigapixels", "169 megapixels", "torn", "PostScript", "empty", "pipe"],
)
def test_a_picture_that_cannot_be_shown_is_told_and_costs_nothing(tmp_path, sheet, words):
    (tmp_path / "run").mkdir()
    if sheet is None:
        os.mkfifo(tmp_path / "run" / "sheet.png")
    else:
        (tmp_path / "run" / "sheet.png").write_bytes(sheet)
    known = content(chart(write_results(tmp_path, result(folder="run"))))
    assert known["configurations"][0]["small"] is None
    (line,) = known["unread"]
    assert "run/sheet.png: not shown" in line and words in line


WORDS = (
    "=1+1",
    "+1",
    "-1",
    "@x",
    "\tx",
    "${oc.env:HOME}",
    "$`x$",
    "$x^{$",
    "`ls`",
    "[/bold]",
    "_x",
    "\\$",
    "a\x1b[2Jb\nc",
)


def test_no_text_of_a_row_is_more_than_text(tmp_path):
    same = {"dataset": "$x^{$", "device": "=$\\`$", "st_lpips_vgg": None}
    rows = [
        result(strategy=word, overrides=[word, f"x={word}"], run_id=word, error=word, model=word, **same)
        for word in WORDS
    ]
    page = chart(write_results(tmp_path, *rows), png__costs=["scene_s"])
    known = content(page)
    assert {entry["strategy"] for entry in known["configurations"]} == set(WORDS)
    for name in ("runs.csv", "configurations.csv"):
        for line in read_csv(page.parent / name):
            assert not any(cell.startswith(("=", "+", "-", "@", "\t")) for cell in line.values() if cell)
            assert line["strategy"].removeprefix("'") in WORDS
    assert [path.name for path in page.parent.glob("*.png")] == ["psnr-scene_s.png"]


def test_pictures_of_very_much_or_very_long_text_are_of_bounded_size(tmp_path):
    rows = [
        result(
            strategy=f"s{n}" + "x" * 5000, scene_s=timing(1.0 + n), psnr=20.0 + n, dataset="d" * 9999, st_lpips_vgg=None
        )
        for n in range(30)
    ]
    page = chart(write_results(tmp_path, *rows), png__costs=["scene_s"], png__lines=5)
    with Image.open(page.parent / "psnr-scene_s.png") as image:
        assert image.size[0] == 1080 and image.size[1] < 2000


@pytest.mark.parametrize("values", [(0.0, -1.0), (1e-99, 9e99), (float("nan"), float("inf"), float("-inf"))])
def test_impossible_numbers_make_a_page(tmp_path, values):
    rows = [
        result(name, overrides=[f"{field}={value}"], st_lpips_vgg=None, **{field: number})
        for value in values
        for name, field, number in (("good", "psnr", value), ("slow", "scene_s", timing(value, value)))
    ]
    rows += [result("cheap", st_lpips_vgg=None), result(seed=1, st_lpips_vgg=None)]
    page = chart(write_results(tmp_path, *rows), png__costs=["scene_s"])
    known = content(page)
    assert len(known["configurations"]) == 2 * len(values) + 2
    assert len(known["panels"][0]["frontiers"]["psnr"]["scene_s"]) and (page.parent / "psnr-scene_s.png").is_file()


def test_runs_that_say_that_they_had_no_scenes_make_a_page(tmp_path):
    assert len(content(chart(write_results(tmp_path, result(n_scenes=0, n_views=0))))["configurations"]) == 1


def test_a_folder_that_cannot_be_read_is_told(tmp_path, monkeypatch):
    write_results(tmp_path, result())
    locked = write_results(tmp_path / "locked", result("slow"))
    scandir = os.scandir

    def refuse(path):
        if Path(path) == locked:
            raise PermissionError(13, "Permission denied", str(path))
        return scandir(path)

    monkeypatch.setattr(os, "scandir", refuse)
    assert content(chart(tmp_path))["unread"] == [f"left out: {locked}: Permission denied"]
