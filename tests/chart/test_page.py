import csv
import io
import json
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
import torch

from chart_fixtures import (
    FRONTIERS,
    KNOWN,
    SCENES,
    chart,
    failed,
    result,
    timing,
    write_results,
    write_scores,
    write_sheet,
)
from nerfdiff.results.pictures import orbit_video

NAMES = list(KNOWN)  # in the order of the page's configurations
PLOT = "document.getElementById('plot')"
LOST = "net::ERR_FILE_NOT_FOUND"


@pytest.fixture(scope="module")
def page_path(tmp_path_factory) -> Path:
    """`KNOWN` on one device, one with two seeds, scores and pictures; some on others; five that failed."""
    folder = tmp_path_factory.mktemp("results")
    rows = [result(name, folder=f"{name}0") for name in KNOWN]
    rows += [result("good", 1, folder="good1")]
    rows += [result(name, device="Fast GPU", scene_s=timing(cost)) for name, cost in (("good", 0.5), ("worse", 0.25))]
    rows += [result(device="Clockless", scene_s=None, denoiser_calls=None, params=None)]
    rows += [failed("slow", 1), failed("slow", 2, status="nan", error="rgb is <not> finite")]
    rows += [failed("good", 7, device="Fast GPU"), failed("best", 5, device="Small GPU")]
    for seed, shift in ((0, 0.0), (1, 0.5)):
        scores = dict(zip(SCENES, (20.0 - shift, 22.0, 24.0 + shift), strict=True))
        write_scores(folder / f"good{seed}", "ngd", scores)
    for name in ("good0", "slow0"):
        write_sheet(folder / name)
        orbit_video(folder / name / "orbit.mp4", torch.rand(4, 3, 16, 16))
    path = chart(write_results(folder, *rows))
    (folder / "slow0" / "orbit.mp4").unlink()  # lost after the page was written
    return path


@pytest.fixture(scope="module")
def one_page(open_page, page_path):
    return open_page(page_path)


@pytest.fixture
def page(one_page):
    """The page as it is when it has just been opened; it may not have complained of anything."""
    if one_page.is_visible("#details"):
        one_page.click("#details .close")
    one_page.select_option("#device", "Test CPU")
    for selector, choice in (("#cost", "scene_s"), ("#colour", "strategy"), ("#axis", "value")):
        one_page.select_option(selector, choice)
    one_page.click("[data-metric=psnr]")
    one_page.check("#intervals")
    one_page.mouse.move(0, 0)
    yield one_page
    complaints, one_page.complaints = one_page.complaints, []
    assert complaints == []


def traces(page, kind: str) -> list[dict]:
    fields = "({ x, y, customdata, type }) => ({ x, y, customdata, type })"
    return page.evaluate(f"{PLOT}.data.filter((trace) => trace.meta === '{kind}').map({fields})")


def drawn(page, kind: str) -> dict[int, tuple[float, float]]:
    """Configurations of a kind (frontier, dominated) and where they stand."""
    return {
        number: (x, y)
        for trace in traces(page, kind)
        for number, x, y in zip(trace["customdata"], trace["x"], trace["y"], strict=True)
    }


def pixels(page, x: float, y: float) -> list[float]:
    """Where a point of the chart is on the screen."""
    return page.evaluate(
        """([x, y]) => {
            const plot = document.getElementById("plot"), { _size, xaxis, yaxis } = plot._fullLayout;
            plot.scrollIntoView({ block: "center" });
            const { left, top } = plot.getBoundingClientRect();
            return [left + _size.l + xaxis.d2p(x), top + _size.t + yaxis.d2p(y)];
        }""",
        [x, y],
    )


def place(page, number: int) -> list[float]:
    return pixels(page, *(drawn(page, "frontier") | drawn(page, "dominated"))[number])


def hover(page, x: float, y: float) -> str:
    page.mouse.move(x - 40, y - 30)
    page.mouse.move(x, y, steps=4)
    page.wait_for_selector("#tip:not([hidden])")
    return page.inner_text("#tip")


def click(page, number: int):
    hover(page, *place(page, number))
    page.mouse.click(*place(page, number))
    page.wait_for_selector("#details:not([hidden])")
    return page.locator("#details")


def test_the_frontier_is_the_true_one(page):
    for metric, names in FRONTIERS.items():
        page.click(f"[data-metric={metric}]")
        expected = {NAMES.index(name): (KNOWN[name][1], KNOWN[name][2 if metric == "psnr" else 3]) for name in names}
        assert drawn(page, "frontier") == expected
        assert set(drawn(page, "dominated")) == set(range(len(KNOWN))) - expected.keys()
        (step,) = traces(page, "step")
        assert list(zip(step["x"], step["y"], strict=True))[:-1] == list(expected.values())
        assert step["y"][-1] == step["y"][-2]  # on to the right edge
        low, high = page.evaluate(f"{PLOT}._fullLayout.yaxis.range")
        assert (low < high) == (metric == "psnr")  # up is better
    assert page.evaluate(f"{PLOT}._fullLayout.xaxis.type") == "log"


def test_selectors_change_what_is_shown(page):
    assert drawn(page, "frontier").keys() | drawn(page, "dominated").keys() == set(range(5))
    page.select_option("#cost", "denoiser_calls")
    assert drawn(page, "frontier").keys() == {NAMES.index(name) for name in FRONTIERS["psnr"]}
    # a logarithmic axis has no zero: it has a tick of its own
    ticks = page.evaluate(f"[{PLOT}._fullLayout.xaxis.tickvals, {PLOT}._fullLayout.xaxis.ticktext]")
    assert dict(zip(*ticks, strict=True))[drawn(page, "frontier")[0][0]] == "0"
    page.select_option("#colour", "inner_steps")
    assert page.locator("#legend .name").all_inner_texts()[:5] == ["1", "2", "4", "8", "16"]
    assert page.locator("#failed-strip button").count() == 3
    page.select_option("#device", "Fast GPU")
    assert drawn(page, "frontier").keys() | drawn(page, "dominated").keys() == {5, 6}
    assert page.input_value("#cost") == "denoiser_calls"  # as chosen
    assert page.locator("#failed-strip button").count() == 4  # three of no device, or of one without a success
    assert page.locator("#table tbody tr").count() == 2


def test_a_link_shows_what_was_chosen(page, page_path):
    page.select_option("#device", "Fast GPU")
    page.click("[data-metric=st_lpips_vgg]")
    page.select_option("#cost", "params")
    link = page.url
    page.select_option("#device", "Test CPU")
    assert page.url != link
    page.goto("about:blank")  # else only the hash would change
    page.goto(link)
    page.wait_for_selector("body[data-ready=yes]")
    assert [page.input_value(f"#{name}") for name in ("device", "cost")] == ["Fast GPU", "params"]
    assert page.get_attribute("[data-metric=st_lpips_vgg]", "aria-pressed") == "true"
    page.goto("about:blank")
    page.goto(f"{page_path.as_uri()}#panel=77&metric=money&cost=&colour=x")  # nothing of it is there
    page.wait_for_selector("body[data-ready=yes]")
    assert [page.input_value(f"#{name}") for name in ("device", "cost", "colour")] == [
        "Test CPU",
        "scene_s",
        "strategy",
    ]


def test_an_open_page_follows_its_address(page):
    page.evaluate("location.hash = 'panel=0&metric=st_lpips_vgg&cost=denoiser_calls&colour=inner_steps'")
    page.wait_for_function("document.getElementById('cost').value === 'denoiser_calls'")
    assert page.get_attribute("[data-metric=st_lpips_vgg]", "aria-pressed") == "true"
    assert page.input_value("#colour") == "inner_steps"


def pressed(page) -> dict[str, bool]:
    """Whether each button of the legend shows its points."""
    buttons = page.locator("#legend button").evaluate_all(
        "found => found.map((each) => [each.dataset.group, each.ariaPressed])"
    )
    return {group: state == "true" for group, state in buttons}


def all_drawn(page) -> set[int]:
    return drawn(page, "frontier").keys() | drawn(page, "dominated").keys()


def test_what_the_legend_hides_stays_hidden_and_nothing_else_is(page):
    page.click("#legend [data-group=ngd]")
    hidden, others = {"direct": True, "ngd": False, "none": True, "sds": True}, {0, 1, 4}
    assert pressed(page) == hidden and all_drawn(page) == others
    page.click("[data-metric=st_lpips_vgg]")
    assert pressed(page) == hidden and all_drawn(page) == others
    page.select_option("#colour", "inner_steps")  # numbers, whose legend hides nothing
    assert pressed(page) == {} and all_drawn(page) == set(range(5))
    page.select_option("#colour", "strategy")
    page.focus("#legend [data-group=ngd]")
    page.keyboard.press("Enter")
    assert all(pressed(page).values()) and all_drawn(page) == set(range(5))
    page.click("#legend [data-group=sds]", modifiers=["Shift"])
    assert all_drawn(page) == {4}
    page.click("#legend [data-group=sds]")
    for name in hidden:
        page.click(f"#legend [data-group={name}]")
    assert all(pressed(page).values())


def test_what_memory_is_on_a_cpu_is_told(open_page, tmp_path):
    rows = [result(peak_mem_bytes=2**30), result("slow", peak_mem_bytes=2**31, device="GPU")]
    page = open_page(chart(write_results(tmp_path, *rows)))
    page.select_option("#cost", "peak_mem_bytes")
    assert "resident set of the whole process" in page.inner_text("#plot-note")
    page.select_option("#device", "GPU")
    assert page.input_value("#cost") == "peak_mem_bytes" and "resident" not in page.inner_text("#plot-note")


def test_what_has_no_cost_is_in_the_table_alone(page):
    page.select_option("#device", "Clockless")
    assert "No configuration here has both PSNR and seconds per scene" in page.inner_text("#plot")
    assert page.locator("#table tbody tr").count() == 1 and page.is_hidden("#pick")
    page.select_option("#device", "Test CPU")
    assert page.locator("#plot .main-svg").count() > 0 and page.is_visible("#pick")
    click(page, NAMES.index("good"))


def test_published_values_are_markers_of_another_kind_with_their_source(page):
    assert not page.is_checked("#published") and traces(page, "published") == []  # until they are asked for
    page.select_option("#axis", "difference")
    page.check("#published")
    assert page.input_value("#axis") == "value"  # they are no differences
    (timed,), (untimed,) = traces(page, "published"), traces(page, "published without a cost")
    costs = {entry["published"]["method"]: x for entry, x in zip(timed["customdata"], timed["x"], strict=True)}
    assert costs["VisionNeRF"] == pytest.approx(0.015 + 4 * 0.678)
    methods = costs.keys() | {entry["published"]["method"] for entry in untimed["customdata"]}
    assert methods > {"SRN", "SSDNeRF", "NerfDiff-B", "Splatter Image"}
    labels = page.evaluate(f"{PLOT}.layout.annotations.map(({{ text }}) => text)")
    assert set(labels) == {*methods, "cost not published"}  # which is what the column beyond the axis is called
    assert min(untimed["x"]) > max(timed["x"])
    ticks = page.evaluate(f"{PLOT}._fullLayout.xaxis.tickvals")
    assert max(ticks) < min(untimed["x"])
    assert "128×128 pixels, other test images and other devices" in page.inner_text("#plot-note")
    said = hover(page, *pixels(page, costs["Splatter Image"], 24.0))
    assert "Splatter Image" in said and "Szymanowicz et al." in said and "V100" in said
    page.uncheck("#published")
    assert traces(page, "published") == []


def test_hovering_shows_the_overrides(page):
    said = hover(page, *place(page, NAMES.index("slow")))
    assert "budget.inner_steps=8" in said and "ckpt=demo" not in said and "seed=" not in said
    assert "21.90" in said and "2 more failed" in said
    page.wait_for_function("document.querySelector('#tip img').naturalWidth > 0")  # a thumbnail, within the page
    assert page.get_attribute("#tip img", "src").startswith("data:image/webp")
    said = hover(page, *place(page, NAMES.index("best")))  # without pictures there is room for all
    assert "budget.inner_steps=16" in said and "ckpt=demo" in said and page.locator("#tip img").count() == 0


def test_clicking_shows_pictures_and_the_command(page):
    details = click(page, NAMES.index("good"))
    assert details.locator("pre").inner_text() == result("good").command
    assert details.locator("a[href='../good0/sheet.png']").count() == 1
    page.wait_for_function("document.querySelector('#details img').naturalWidth > 0")
    page.wait_for_function("document.querySelector('#details video').readyState > 0")
    assert details.locator("video").get_attribute("src") == "../good0/orbit.mp4"
    # the plot makes room
    assert page.evaluate(f"{PLOT}.getBoundingClientRect().right < document.querySelector('aside').offsetLeft")
    details.locator(".seeds button").nth(1).click()
    assert details.locator("pre").inner_text() == result("good", 1).command
    assert "left no pictures" in details.inner_text()
    details.locator(".close").click()
    assert details.is_hidden()


def test_a_lost_picture_is_told(page):
    details = click(page, NAMES.index("slow"))
    page.wait_for_selector("#details :text('not where it was when this page was written: ../slow0/orbit.mp4')")
    page.wait_for_function("document.querySelector('#details img').naturalWidth > 0")  # the one within the page
    assert details.locator("video").count() == 0
    assert all(LOST in said for said in page.complaints) and page.complaints
    page.complaints.clear()


@pytest.mark.parametrize("metric", ["psnr", "st_lpips_vgg"])
def test_the_advice_is_the_fastest_within_x_of_the_best(page, metric):
    page.click(f"[data-metric={metric}]")
    better, at = (1, 2) if metric == "psnr" else (-1, 3)
    best = max(better * known[at] for known in KNOWN.values())
    told = set()
    for within in (0.0, 0.04, 0.06, 0.12, 1.0, 2.5):
        page.fill("#within", str(within))
        near = [name for name in KNOWN if best - better * KNOWN[name][at] <= within + 1e-9]
        expected = min(near, key=lambda name: KNOWN[name][1])
        assert page.get_attribute("#advice", "data-pick") == str(NAMES.index(expected))
        told.add(expected)
    assert len(told) > 2
    page.locator("#advice button").first.click()
    assert page.locator("#details pre").inner_text() == result(expected).command


def test_failed_runs_say_why(page):
    strip = page.locator("#failed-strip button")
    assert [text.split(" ")[1] for text in strip.all_inner_texts()] == ["oom", "nan", "oom"]
    strip.nth(1).click()
    details = page.inner_text("#details")
    assert "rgb is <not> finite" in details and "budget.inner_steps=8" in details
    assert "python src/distill.py seed=2" in details


def wait_for_rows(page, steps: list[str]) -> None:
    """Until the table's rows are these, by their inner steps."""
    cells = "[...document.querySelectorAll('#table tbody tr td:nth-child(6)')].map((cell) => cell.innerText).join()"
    page.wait_for_function(f"{cells} === '{','.join(steps)}'")


def test_the_table_sorts_and_filters_and_is_the_csv(page, page_path):
    by_cost = page.locator("#table-section th", has_text="seconds per scene").locator(".dt-column-title").first
    by_cost.click()
    wait_for_rows(page, ["1", "2", "4", "8", "16"])
    by_cost.click()
    wait_for_rows(page, ["16", "8", "4", "2", "1"])
    page.locator("#table-section input[type=search]").first.fill("ngd")
    wait_for_rows(page, ["8", "4"])
    with page.expect_download() as download:
        page.click("#csv")
    lines = list(csv.DictReader(io.StringIO(Path(download.value.path()).read_text())))
    assert [line["inner_steps"] for line in lines] == ["8", "4"]
    with open(page_path.parent / "configurations.csv", newline="") as file:
        beside = {line["overrides"]: line for line in csv.DictReader(file) if line["device"] == "cpu"}
    for line in lines:
        same = beside[f"budget.inner_steps={line['inner_steps']} ckpt=demo strategy=ngd"]
        for name in ("psnr", "psnr_low", "psnr_high", "scene_s", "st_lpips_vgg"):
            assert line[name] == same[name] or float(line[name]) == pytest.approx(float(same[name]), rel=1e-5)
    page.locator("#table tbody tr").first.click()
    assert page.locator("#details pre").inner_text() == result("slow").command
    page.complaints.clear()  # its orbit is lost


@pytest.fixture
def phone(page):
    page.set_viewport_size({"width": 390, "height": 844})
    yield page
    page.set_viewport_size({"width": 1400, "height": 1000})


def test_a_phone_shows_it_all(phone):
    page = phone
    page.wait_for_function("document.documentElement.scrollWidth <= 390")
    page.touchscreen.tap(*place(page, NAMES.index("good")))
    page.wait_for_selector("#details:not([hidden])")
    box = page.locator("#details").bounding_box()
    assert box["x"] >= 0 and box["x"] + box["width"] <= 390 and box["y"] + box["height"] <= 845
    assert page.locator("#details pre").inner_text() == result("good").command
    page.wait_for_function(f"{PLOT}.clientWidth < 390 && {PLOT}.querySelector('.main-svg').clientWidth < 390")


def test_words_of_overrides_are_text_and_no_elements(open_page, tmp_path):
    names = ("<img src=x>", "<b>bold</b>", "<a href='https://x.org'>x</a>")
    rows = [result(overrides=["strategy=ngd", f"run_name={name}"], run_id=name) for name in names]
    page = open_page(chart(write_results(tmp_path, *rows, failed("slow", strategy=None))))
    assert {text for text in page.locator("#table tbody td").all_inner_texts() if "<" in text} == set(names)
    page.select_option("#colour", "run_name")
    assert set(names) < set(page.locator("#legend .name").all_inner_texts())
    assert page.locator("#legend a, #legend b, #legend img, #plot a").count() == 0
    page.locator("#failed-strip button").click()
    assert page.inner_text("#details h2") == "oom"
    assert page.locator("#table img, #table b").count() == 0 and page.complaints == []


def test_five_thousand_rows_stay_light(open_page, tmp_path):
    """What makes pages slow does not grow with the rows: elements, and points that are elements."""
    rng = np.random.default_rng(0)
    costs, values = 10 ** rng.uniform(0, 3, 5000), rng.normal(20, 1, 5000)
    settings = [[f"budget.inner_steps={n % 50}", f"budget.lr={n / 1000}", f"x=w{n // 9}"] for n in range(5000)]
    row = asdict(result())
    lines = [
        row | {"psnr": psnr, "scene_s": timing(cost), "overrides": words, "command": " ".join(words), "run_id": str(n)}
        for n, (cost, psnr, words) in enumerate(zip(costs.tolist(), values.tolist(), settings, strict=True))
    ]
    path = write_results(tmp_path) / "results.jsonl"
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))
    page = open_page(chart(tmp_path))
    points = [trace for kind in ("frontier", "dominated") for trace in traces(page, kind)]
    assert sum(len(trace["x"]) for trace in points) == 5000
    assert {trace["type"] for trace in points} == {"scattergl"}
    for key in ("lr", "x", "inner_steps"):  # 5000 numbers, 556 words, 50 numbers
        page.select_option("#colour", key)
        assert page.evaluate(f"{PLOT}.data.length") < 40
        assert sum(len(trace["x"]) for kind in ("frontier", "dominated") for trace in traces(page, kind)) == 5000
    assert page.evaluate(f"{PLOT}.data.every(({{ error_y }}) => !error_y?.visible)")
    assert "Intervals of more than 400 points" in page.inner_text("#plot-note")
    assert page.evaluate("document.querySelectorAll('*').length") < 3000
    best = {n for n in range(5000) if not ((costs <= costs[n]) & (values > values[n])).any()}
    assert drawn(page, "frontier").keys() == best
    number = min(best, key=lambda n: costs[n])
    assert click(page, number).locator("pre").inner_text() == " ".join(settings[number])
    page.click("[data-metric=st_lpips_vgg]")
    assert drawn(page, "frontier").keys() == {int(costs.argmin())}  # all have the same
    page.locator("#table-section input[type=search]").first.fill("nothing like it")
    page.wait_for_function("document.querySelectorAll('#table tbody tr').length === 1")
    assert page.complaints == []


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        ([], "There are no results in"),
        ([failed(), failed("slow", 3)], "All 2 runs in"),
        ([result()], "It is the best itself"),
    ],
)
def test_pages_of_little_or_nothing_say_so(open_page, tmp_path, rows, words):
    path = chart(write_results(tmp_path, *rows))
    assert path.stat().st_size < 100_000 or rows[0].status == "ok"  # without a chart it needs no library of charts
    page = open_page(path)
    assert words in page.inner_text("main")
    assert page.locator("#failed-strip button").count() == sum(row.status != "ok" for row in rows)
    assert page.complaints == []
