"""The page's view of where strategies break, in a browser: known rows give the known heat map."""

from itertools import pairwise

import numpy as np
import pytest
from PIL import Image

from chart_fixtures import TIME, chart, result, write_results
from nerfdiff.chart.page import PARTS
from nerfdiff.results.row import ResultRow, append_row

SCENES = ("a", "b")
CLEAN = {"none": 20.0, "ngd": 21.0, "copy_input": 12.0, "mean_image": 13.0}
# axis: neutral severity, severity: PSNR of none and of ngd, and what the judge says
FOCAL = {0.85: (19.5, 20.5, "ok"), 0.7: (18.0, 17.0, "ok"), 1.2: (19.0, 20.0, "ok"), 2.0: (12.0, 10.0, "suspect: haze")}
ROWS = {
    "focal": (1.0, FOCAL),
    "noise": (0.0, {0.12: (19.5, 20.5, "ok"), 0.38: (19.0, 20.0, "ok")}),
    "ambiguous": (None, {1.0: (19.0, 20.0, "ok"), 2.0: (16.0, 17.0, "ok")}),
}


def write_run(home, strategy, psnr, stress=None, severity=None, neutral=None, verdict="ok", status="ok"):
    folder = f"{stress}{severity}{strategy}"
    words = [f"stress={stress or 'none'}", *([f"stress.severity={severity}"] if stress else [])]
    row = ResultRow(
        run_id=folder, time=TIME, status=status, strategy=strategy, seed=0, folder=folder, device="cpu",
        overrides=["ckpt=demo", f"strategy={strategy}", *words], stress=stress, severity=severity, neutral=neutral,
    )  # fmt: skip
    append_row(home / "results.jsonl", row)
    if status != "ok":
        return
    scores = home / folder / "scores" / strategy / "per_scene.csv"
    scores.parent.mkdir(parents=True)
    lines = [f"{scene},4,ok,{verdict},0,{psnr + shift}\n" for scene, shift in zip(SCENES, (-0.1, 0.1), strict=True)]
    scores.write_text("scene,views,status,verdict,blank,psnr\n" + "".join(lines))
    for scene in SCENES:
        rgb = home / folder / "predictions" / strategy / scene / "rgb"
        rgb.mkdir(parents=True)
        for view in ("0", "1"):
            Image.fromarray(np.full((8, 8, 3), int(5 * psnr), np.uint8)).save(rgb / f"{view}.png")


@pytest.fixture(scope="module")
def page_path(tmp_path_factory):
    home = tmp_path_factory.mktemp("stability")
    write_results(home, result("good"))
    for strategy, psnr in CLEAN.items():
        write_run(home, strategy, psnr)
    for axis, (neutral, severities) in ROWS.items():
        for severity, (none, ngd, verdict) in severities.items():
            for strategy, psnr in (("none", none), ("ngd", ngd)):
                write_run(home, strategy, psnr, axis, severity, neutral, verdict)
    write_run(home, "ngd", 0.0, "lr_planes", 30.0, 1.0, status="nan")
    return chart(home)


@pytest.fixture(scope="module")
def page(open_page, page_path):
    page = open_page(page_path)
    yield page
    assert page.complaints == []


def cell(page, axis, strategy):
    return page.locator(f"#heat button[data-axis={axis}][data-strategy={strategy}]")


def test_known_rows_give_the_known_heat_map(page):
    assert page.is_visible("#stability")
    heads = page.locator("#heat thead th").all_inner_texts()
    assert heads == ["axis", "none", "ngd"]
    names = page.locator("#heat tbody th").all_inner_texts()
    axes = ["focal length", "Gaussian noise", "ambiguous input", "learning rate of the planes"]
    assert names == ["clean PSNR, dB", *axes]
    assert page.locator("#heat tbody tr").first.locator("td").all_inner_texts() == ["20.00", "21.00"]
    assert cell(page, "focal", "none").inner_text().startswith("> ×0.7 true / ×2 true (b)")
    assert cell(page, "focal", "ngd").inner_text().startswith("×0.7 true (bc) / ×2 true (bc)")
    assert cell(page, "noise", "ngd").inner_text() == "> 0.38 σ"
    assert cell(page, "ambiguous", "ngd").inner_text().startswith("front (b)")
    assert cell(page, "lr_planes", "ngd").inner_text() == "×30 (a)" and cell(page, "lr_planes", "none").count() == 0
    shown = [cell(page, axis, "ngd").evaluate("cell => cell.style.background") for axis in ("noise", "lr_planes")]
    assert shown[0] != shown[1]


def test_silent_failures_are_the_headline(page):
    """ngd at ×0.7 and both at `front`, two scenes each, with status and verdict ok; at ×2 the judge tells."""
    assert page.inner_text("#silent").startswith("Silent failures: 6 of 10 broken scenes")
    assert "6 by rule (b), 0 by rule (c) alone" in page.inner_text("#silent")
    assert page.get_attribute("#silent", "class") == "bad"
    assert "● 2 silent" in cell(page, "focal", "ngd").inner_text()


def test_a_click_shows_the_curve_with_intervals_and_the_first_scene_that_breaks(page):
    cell(page, "focal", "ngd").click()
    assert page.inner_text("#curve-title").startswith("focal length: ngd breaks at ×0.7 true")
    fields = "({ name, x, y, marker, error_y }) => ({ name, x, y, symbol: marker.symbol, above: error_y.array })"
    traces = page.evaluate(f"document.getElementById('curve').data.map({fields})")
    assert [trace["name"] for trace in traces] == ["none", "ngd"]
    assert traces[1]["x"] == ["×0.7 true", "×0.85 true", "×1.2 true", "×2 true"]
    assert traces[1]["y"] == pytest.approx([4.0, 0.5, 1.0, 11.0], abs=1e-6)
    assert traces[1]["symbol"] == ["x", "circle", "circle", "x"] and len(traces[1]["above"]) == 4
    assert page.locator("#curve-pictures img").count() == 2 and "scene a at ×0.7 true" in page.inner_text(
        "#curve-pictures"
    )
    size = page.locator("#curve-pictures img").first.evaluate("image => [image.naturalWidth, image.naturalHeight]")
    assert size == [32, 32]  # two views, clean above and broken below, twice as large
    assert page.locator("#curve-points tr").count() == 5
    cell(page, "lr_planes", "ngd").click()
    assert "it left no pictures" in page.inner_text("#curve-pictures")
    assert "2 of 2" in page.inner_text("#curve-points")


def test_the_heat_map_is_walked_with_the_keyboard(page):
    cell(page, "focal", "none").focus()
    focused = "[document.activeElement.dataset.axis, document.activeElement.dataset.strategy]"
    for key, wanted in (
        ("ArrowRight", ["focal", "ngd"]),
        ("ArrowDown", ["noise", "ngd"]),
        ("ArrowLeft", ["noise", "none"]),
    ):
        page.keyboard.press(key)
        assert page.evaluate(focused) == wanted
    page.keyboard.press("ArrowRight")
    page.keyboard.press("Enter")
    assert page.inner_text("#curve-title").startswith("Gaussian noise: ngd")
    assert page.evaluate("document.activeElement.id") == "curve-title"


def luminance(colour: str) -> float:
    parts = [int(colour[at : at + 2], 16) / 255 for at in (1, 3, 5)]
    linear = [part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4 for part in parts]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


def test_colours_are_told_apart_by_their_lightness_alone_and_words_are_legible_on_them():
    script = (PARTS / "stability.js").read_text()
    scale = script.partition("const HEAT = [")[2].partition("]")[0].replace('"', "").split(", ")
    light = [luminance(colour) for colour in scale]
    assert light == sorted(light) and all(b - a > 0.03 for a, b in pairwise(light))
    for at, back in enumerate(light):  # WCAG: 4.5, for what stands on them
        ink = 1.0 if at / len(light) < 0.6 else luminance("#1d2430")
        high, low = max(ink, back), min(ink, back)
        assert (high + 0.05) / (low + 0.05) > 3.9, scale[at]


def test_a_phone_shows_all_of_it(page):
    page.set_viewport_size({"width": 390, "height": 800})
    page.wait_for_function("document.documentElement.scrollWidth <= 390")  # the curve follows the window
    cell(page, "focal", "ngd").click()
    box = page.locator("#curve").bounding_box()
    assert box["width"] <= 390 and box["height"] > 200
    assert page.locator("#heat-box").evaluate("box => box.scrollWidth >= box.clientWidth")
    page.set_viewport_size({"width": 1400, "height": 1000})


def test_stressed_runs_are_no_choices_of_speed(page):
    assert page.evaluate("JSON.parse(document.getElementById('data').textContent).configurations.length") == 5


def test_a_page_without_stresses_has_no_such_view(open_page, tmp_path):
    page = open_page(chart(write_results(tmp_path, result("good"))))
    assert not page.is_visible("#stability") and page.complaints == []
