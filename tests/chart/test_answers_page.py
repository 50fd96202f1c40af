"""What the page answers, in a browser: the known rows of `answering`."""

import pytest

from chart_fixtures import ANSWERS, answering, chart, result, write_results

NAMES = list(ANSWERS)
PLOT = "document.getElementById('plot')"
SOLID = {number for number, own in enumerate(ANSWERS.values()) if own[4]}


@pytest.fixture(scope="module")
def one_page(open_page, tmp_path_factory):
    folder = answering(tmp_path_factory.mktemp("answers"))
    extra = result(
        strategy="ngd",
        overrides=["strategy=ngd", "budget=adaptive"],
        run_id="adaptive",
        denoiser_calls=12,
        K=16,
        n_scenes=16,
    )
    return open_page(chart(write_results(folder, extra)))


@pytest.fixture
def page(one_page):
    """As it is when it has just been opened."""
    if one_page.is_visible("#details"):
        one_page.click("#details .close")
    one_page.check("#only")
    one_page.uncheck("#published")
    for selector, choice in (("#cost", "scene_s"), ("#colour", "strategy"), ("#axis", "difference")):
        one_page.select_option(selector, choice)
    one_page.click("[data-metric=psnr]")
    one_page.mouse.move(0, 0)
    yield one_page
    assert one_page.complaints == []


def drawn(page) -> dict[int, dict]:
    """Per configuration where it stands, how far its bar reaches, and its mark."""
    ends = "trace.error_y.visible ? [-trace.error_y.arrayminus[at], trace.error_y.array[at]] : null"
    script = f"""{PLOT}.data.filter((trace) => ["frontier", "dominated"].includes(trace.meta)).flatMap((trace) =>
        trace.customdata.map((number, at) => [number, {{ y: trace.y[at], symbol: trace.marker.symbol[at], bar: {ends},
            line: trace.marker.line.width[at] }}]))"""
    return dict(page.evaluate(script))


def test_the_axis_is_the_difference_and_bars_are_its_interval(page):
    points = drawn(page)
    ngd, none = points[NAMES.index("ngd")], points[NAMES.index("none")]
    assert ngd["y"] == pytest.approx(1.0, abs=1e-5) and none["y"] == 0
    assert -0.1 < ngd["bar"][0] < 0 < ngd["bar"][1] < 0.1  # scenes alone spread by 8 dB
    assert not any(none["bar"] or [])
    page.uncheck("#intervals")
    assert drawn(page)[NAMES.index("ngd")]["bar"] is None
    page.check("#intervals")
    page.select_option("#axis", "value")
    assert drawn(page)[NAMES.index("ngd")]["y"] == pytest.approx(24.75, abs=1e-4)
    assert drawn(page)[NAMES.index("ngd")]["bar"] == pytest.approx(ngd["bar"])


def test_only_3d_leaves_out_what_has_no_field(page):
    assert page.is_checked("#only") and NAMES.index("cdm") not in drawn(page)
    assert "leaves out what has views and no field: cdm" in page.inner_text("#plot-note")
    page.uncheck("#only")
    assert NAMES.index("cdm") in drawn(page)
    assert page.locator("[data-pick=sharp]").get_attribute("data-number") == str(NAMES.index("cdm"))
    assert "cdm" in page.inner_text("#table tbody")
    page.check("#only")
    assert "cdm" not in page.inner_text("#table tbody")


def test_three_picks_have_their_reason_and_command(page):
    numbers = [card.get_attribute("data-number") for card in page.locator(".pick").all()]
    assert numbers == [str(NAMES.index(name)) for name in ("none", "ngd", "ngd_sharp")]
    assert "that lead is noise, so the cheaper one wins" in page.inner_text("[data-pick=balanced]")
    page.context.grant_permissions(["clipboard-read", "clipboard-write"])
    page.click("[data-pick=balanced] .copy")
    page.wait_for_function("document.querySelector('[data-pick=balanced] .copy').textContent === 'copied'")
    assert page.evaluate("navigator.clipboard.readText()") == "python src/distill.py strategy=ngd ckpt=demo"
    assert "Level with it, as far as intervals say: ngd" in page.inner_text("#advice")


def test_the_table_begins_with_strategy_metric_and_seconds(page):
    heads = "[...document.querySelectorAll('.dt-scroll-head th .dt-column-title')].map((each) => each.textContent)"
    assert page.evaluate(heads)[:5] == ["strategy", "PSNR, dB", "seconds per scene", "Δ PSNR to none", "verdict"]
    rows = [row.split("\t")[:5] for row in page.inner_text("#table tbody").splitlines()]
    verdicts = {cells[0]: cells[4] for cells in rows if cells[1] != "22.00"}
    assert verdicts == {
        "none": "the reference", "direct": "level with none", "ngd": "better than none",
        "ngd_sharp": "better than none", "ngd_current": "better than none", "sds": "worse than none",
    }  # fmt: skip
    page.click("[data-metric=st_lpips_vgg]")
    assert page.evaluate(heads)[1] == "ST-LPIPS"
    page.select_option("#cost", "denoiser_calls")
    assert page.evaluate(heads)[2:4] == ["seconds per scene", "denoiser calls per scene"]


def test_strategies_have_shapes_and_the_field_can_be_the_colour(page):
    symbols = {
        ANSWERS_NAME: drawn(page)[number]["symbol"] for number, ANSWERS_NAME in enumerate(NAMES) if number in SOLID
    }
    assert len(set(symbols.values())) == len(symbols)
    page.select_option("#colour", "field")
    entries = page.locator("#legend .name").all_inner_texts()
    assert {"triplane", "not set", *symbols} <= set(entries)
    assert {name: drawn(page)[NAMES.index(name)]["symbol"] for name in symbols} == symbols
    page.select_option("#colour", "budget")
    assert page.locator("#legend button").all_inner_texts() == ["adaptive", "fixed"]


def test_adaptive_points_stand_beside_fixed_ones(page):
    points = drawn(page)
    assert points[len(NAMES)]["line"] == 2.5 and points[NAMES.index("ngd")]["line"] < 2
    assert points[len(NAMES)]["symbol"] == points[NAMES.index("ngd")]["symbol"]
    assert "adaptive budget" in page.inner_text("#legend")


def test_the_keyboard_reaches_everything(page):
    page.focus("#plot")
    order = [NAMES.index(name) for name in ("none", "direct")]
    for number in order:
        page.keyboard.press("ArrowRight")
        assert NAMES[number] in page.inner_text("#tip")
    assert "level with none" in page.inner_text("#plot-said")
    page.keyboard.press("Home")
    page.keyboard.press("ArrowUp")  # the next better one
    assert "direct" in page.inner_text("#tip b >> nth=0")
    page.keyboard.press("End")
    page.keyboard.press("ArrowLeft")
    assert page.inner_text("#tip b >> nth=0") == "ngd_current"
    _, high = page.evaluate(f"{PLOT}._fullLayout.yaxis.range")
    page.keyboard.press("+")
    page.wait_for_function(f"{PLOT}._fullLayout.yaxis.range[1] < {high}")
    page.keyboard.press("0")
    page.wait_for_function(f"{PLOT}._fullLayout.yaxis.range[1] === {high}")
    page.keyboard.press("Enter")
    assert page.inner_text("#details h2") == "ngd_current"
    assert page.evaluate("document.activeElement.className") == "close"
    page.keyboard.press("Escape")
    page.keyboard.press("Escape")
    assert page.is_hidden("#details") and page.evaluate("document.activeElement.id") == "plot"
    page.focus("[data-metric=psnr]")
    page.keyboard.press("ArrowRight")
    page.keyboard.press("Enter")
    assert page.get_attribute("[data-metric=st_lpips_vgg]", "aria-pressed") == "true"
    page.focus("#table tbody tr[tabindex='0']")
    page.keyboard.press("ArrowDown")
    second = page.evaluate("document.activeElement.cells[0].textContent")
    page.keyboard.press("Enter")
    assert page.inner_text("#details h2").startswith(second)
    page.keyboard.press("Escape")
    assert page.evaluate("document.activeElement.cells[0].textContent") == second


def test_what_has_the_keyboard_is_seen(page):
    seen = set()
    page.focus("#device") if page.is_enabled("#device") else page.focus(".pick button")
    for _ in range(30):
        page.keyboard.press("Tab")
        name, width = page.evaluate(
            "[document.activeElement.id || document.activeElement.className, "
            "getComputedStyle(document.activeElement).outlineWidth]"
        )
        assert width == "3px", name
        seen.add(name)
    assert {"cost", "axis", "colour", "only", "intervals", "published", "card", "entry", "within"} <= seen
    assert any("js-plotly" in name or name == "plot" for name in seen)


def test_a_point_shows_its_thumbnail_to_the_keyboard_too(page):
    page.focus("#plot")
    page.keyboard.press("Home")  # none
    page.wait_for_function("document.querySelector('#tip img').naturalWidth > 0")
    assert page.get_attribute("#tip img", "src").startswith("data:image/webp;base64,")
    box = page.locator("#tip img").bounding_box()
    assert box["width"] <= 310 and box["height"] <= 180


def test_details_show_spending_against_difficulty(page):
    page.click("[data-pick=sharp] .link")
    assert page.locator("#scatter circle").count() == 16
    assert "Spearman's ρ" in page.inner_text(".spending") and "seconds of distillation +1.00" in page.inner_text(
        ".spending"
    )
    page.click("[data-pick=balanced] .link")
    assert "seconds of distillation – (the same for all scenes)" in page.inner_text(".spending")
    assert "+1.00 [" in page.inner_text("#details table")  # its PSNR to none


def test_a_link_keeps_the_switch_and_the_axis(page):
    page.uncheck("#only")
    page.select_option("#axis", "value")
    assert "axis=value" in page.url and "only=all" in page.url


def test_a_phone_has_no_sideways_scrolling(page):
    page.set_viewport_size({"width": 390, "height": 844})
    page.wait_for_function("document.documentElement.scrollWidth <= 390")
    for card in page.locator(".pick").all():
        box = card.bounding_box()
        assert box["x"] >= 0 and box["x"] + box["width"] <= 390
    page.click("[data-pick=sharp] .link")
    page.wait_for_function("document.documentElement.scrollWidth <= 390")
    page.click("#details .close")
    page.set_viewport_size({"width": 1400, "height": 1000})
