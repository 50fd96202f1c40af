"""What the page answers: differences with intervals, verdicts, picks, spending; from known rows."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from chart_fixtures import ANSWERS, SIXTEEN, answering, chart, failed, result, timing, write_results, write_scores
from nerfdiff.chart.marks import marks_of
from nerfdiff.cli import load_config
from nerfdiff.results.intervals import Bootstrap

NAMES = list(ANSWERS)


def content(page: Path) -> dict:
    return json.loads(re.search(r'<script type="application/json" id="data">(.*?)</script>', page.read_text(), re.S)[1])


@pytest.fixture(scope="module")
def known(tmp_path_factory) -> dict:
    return content(chart(answering(tmp_path_factory.mktemp("answers"))))


def bootstrap() -> Bootstrap:
    settings = load_config("chart", ["results=x"]).bootstrap
    return Bootstrap(settings.resamples, settings.level, settings.seed)


def test_differences_are_paired_scene_by_scene(known):
    (panel,) = known["panels"]
    assert panel["reference"] == NAMES.index("none")
    for name, (_, above, wave, _, _) in ANSWERS.items():
        entry = known["configurations"][NAMES.index(name)]
        if name == "none":
            assert entry["differences"] == {}
            continue
        by_hand = bootstrap()(np.array([above + wave * (-1) ** at for at in np.argsort(np.argsort(SIXTEEN))]))
        assert entry["differences"]["psnr"] == pytest.approx(list(by_hand), abs=1e-4)
        _, low, high = entry["values"]["psnr"]
        assert by_hand.high - by_hand.low < 0.3 * (high - low)  # the spread of scenes is no interval of differences


def test_seeds_are_averaged_within_a_scene_first(tmp_path):
    """Two seeds that disagree by 10 dB, each in its own way: their mean is +1 in every scene."""
    for strategy, seed, shift in (("none", 0, 0.0), ("none", 1, 0.0), ("ngd", 0, 11.0), ("ngd", 1, -9.0)):
        folder, words = f"{strategy}{seed}", [f"seed={seed}", f"strategy={strategy}"]
        write_scores(tmp_path / folder, strategy, {scene: 20.0 + at + shift for at, scene in enumerate(SIXTEEN)})
        row = result("good", seed, strategy=strategy, overrides=words, run_id=folder, folder=folder)
        write_results(tmp_path, row)
    _, ngd = content(chart(tmp_path))["configurations"]
    assert len(ngd["runs"]) == 2 and ngd["differences"]["psnr"] == pytest.approx([1.0, 1.0, 1.0])


def picked(known: dict, switch: str) -> dict[str, str | None]:
    picks = known["panels"][0]["answers"][switch]["picks"]
    return {pick["name"]: None if pick["number"] is None else NAMES[pick["number"]] for pick in picks}


def test_no_pick_rests_on_noise(known):
    assert picked(known, "3d") == {"fast": "none", "balanced": "ngd", "sharp": "ngd_sharp"}
    fast, balanced, _ = known["panels"][0]["answers"]["3d"]["picks"]
    assert "of ngd_current (−0.05 dB [" in balanced["reason"]  # the higher mean, which is noise
    assert "8 s instead of 16 s: that lead is noise, so the cheaper one wins" in balanced["reason"]
    assert "nothing cheaper keeps its PSNR" in fast["reason"]
    best = NAMES.index("ngd_current")
    assert known["panels"][0]["answers"]["3d"]["level"]["psnr"] == {"best": best, "level": [NAMES.index("ngd"), best]}


def test_methods_without_a_field_are_apart(known):
    assert [entry["solid"] for entry in known["configurations"]] == [own[4] for own in ANSWERS.values()]
    assert picked(known, "all")["sharp"] == "cdm"
    (panel,) = known["panels"]
    numbers = {name: set(panel[name]["st_lpips_vgg"]["scene_s"]) for name in ("frontiers", "frontiers_3d")}
    assert NAMES.index("cdm") in numbers["frontiers"] and NAMES.index("ngd") in numbers["frontiers_3d"]
    assert NAMES.index("ngd") not in numbers["frontiers"] and NAMES.index("cdm") not in numbers["frontiers_3d"]


@pytest.mark.parametrize(
    ("values", "solid"),
    [
        ({"strategy": "cdm"}, False),  # old rows, of which only the name says it
        ({"strategy": "copy_input", "denoiser_calls": 0, "field_queries": 0}, False),
        ({"strategy": "mine", "denoiser_calls": 0, "field_queries": 0}, False),
        ({"strategy": "mine"}, True),
        ({"strategy": "stochastic", "K": 4}, True),  # its views were fitted
        ({"strategy": "cdm", "floaters": 0.1}, True),
    ],
)
def test_what_leaves_a_field_is_read_from_rows(tmp_path, values, solid):
    rows = [result("cheap", scene_s=timing(1.0)), result(**{"run_id": "x", "overrides": ["strategy=x"]} | values)]
    assert content(chart(write_results(tmp_path, *rows)))["configurations"][1]["solid"] is solid


def test_views_of_ones_own_method_are_told_by_what_others_measured(tmp_path):
    rows = [result("good", K=4), result("slow", strategy="mine", K=None, overrides=["strategy=mine"])]
    assert [entry["solid"] for entry in content(chart(write_results(tmp_path, *rows)))["configurations"]] == [
        True,
        False,
    ]


@pytest.mark.parametrize("scenes", [5, 0])
def test_few_scenes_and_old_rows_have_neither_intervals_nor_picks(tmp_path, scenes):
    folder = answering(tmp_path, SIXTEEN[:scenes]) if scenes else write_results(tmp_path, result("cheap"), result())
    known = content(chart(folder))
    assert {pick["number"] for pick in known["panels"][0]["answers"]["3d"]["picks"]} == {None}
    assert "of at least 6 scenes" in known["panels"][0]["answers"]["3d"]["picks"][1]["reason"]
    others = [entry for entry in known["configurations"] if entry["strategy"] != "none"]
    assert {len(entry["differences"]["psnr"]) for entry in others} == {1}


def test_without_a_reference_nothing_is_compared(tmp_path):
    known = content(chart(write_results(tmp_path, result("good"), result("slow"), failed())))
    assert known["panels"][0]["reference"] is None
    assert all(entry["differences"] == {} and entry["reference"] is None for entry in known["configurations"])


def test_each_model_is_compared_with_its_own_reference(tmp_path):
    rows = [
        result(
            name,
            ckpt_sha256=model * 64,
            run_id=name + model,
            overrides=[f"strategy={name}", f"ckpt={model}"],
            psnr=psnr,
        )
        for model, shift in (("a", 0.0), ("b", 5.0))
        for name, psnr in (("cheap", 20.0 + shift), ("good", 21.0 + 2 * shift))
    ]
    known = content(chart(write_results(tmp_path, *rows)))
    assert [entry["reference"] for entry in known["configurations"]] == [0, 0, 2, 2]
    assert [entry["differences"].get("psnr") for entry in known["configurations"]] == [None, [1.0], None, [6.0]]
    assert known["panels"][0]["reference"] is None


def test_what_a_scene_took_stands_beside_its_difficulty(known, tmp_path):
    """Scene s0 is the hardest; ngd_sharp spends most on it, ngd the same on all."""
    sharp, same = (known["configurations"][NAMES.index(name)]["spending"] for name in ("ngd_sharp", "ngd"))
    assert sharp["distill"]["rho"] == 1.0 and same["distill"]["rho"] is None
    assert sharp["distill"]["psnr"][0] == 20.0 and sharp["distill"]["spent"][0] == 35.0
    # a run of before has it in its predictions, where the first scene warms up
    for strategy in ("none", "ngd"):
        write_scores(tmp_path / strategy, strategy, {scene: 20.0 + at for at, scene in enumerate(SIXTEEN)})
    for at, scene in enumerate(SIXTEEN):
        path = tmp_path / "ngd" / "predictions" / "ngd" / scene / "scene.json"
        path.parent.mkdir(parents=True)
        cost = {
            "distill": 100.0 - at if at else 999.0,
            "denoiser_calls": at,
            "warm": at > 0,
            "stopped_by": "schedule" if at else "agreement",
        }
        path.write_text(json.dumps({"cost": cost}))
    rows = [result("cheap", folder="none"), result("good", folder="ngd")]
    none, ngd = content(chart(write_results(tmp_path, *rows)))["configurations"]
    assert len(ngd["spending"]["distill"]["spent"]) == 15 and ngd["spending"]["distill"]["rho"] == 1.0
    assert ngd["spending"]["denoiser_calls"]["rho"] == -1.0
    assert none["spending"] is None and (none["adaptive"], ngd["adaptive"]) == (False, True)
    few = content(chart(tmp_path, spending_scenes=0))["configurations"][1]
    assert few["spending"] is None
    (tmp_path / "ngd" / "predictions" / "ngd" / "s3" / "scene.json").write_text("{")
    damaged = content(chart(tmp_path))
    assert damaged["configurations"][1]["spending"] is None
    assert any("what its scenes took cannot be read" in line for line in damaged["unread"])


@pytest.mark.parametrize(
    ("word", "adaptive"),
    [("budget=adaptive", True), ("quality=good", True), ("seconds_per_scene=5", True), ("budget=minutes", False)],
)
def test_adaptive_budgets_are_told_by_their_overrides(tmp_path, word, adaptive):
    known = content(chart(write_results(tmp_path, result(overrides=["strategy=ngd", word]))))
    assert known["configurations"][0]["adaptive"] is adaptive


def test_strategies_are_told_apart_without_colour():
    marks = marks_of({f"strategy{number}" for number in range(24)})
    assert len({(mark.colour, mark.shape) for mark in marks.values()}) == 24
    first = list(marks.values())[:12]
    assert len({mark.shape for mark in first}) == len({mark.marker for mark in first}) == 12
