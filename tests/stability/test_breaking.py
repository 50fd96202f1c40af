"""Breaking points of curves whose answer is known."""

import math
from dataclasses import replace

import pytest

from chart_fixtures import TIME
from nerfdiff.results.frame import Run, read_runs
from nerfdiff.results.intervals import Bootstrap
from nerfdiff.results.row import ResultRow, append_row
from nerfdiff.stability.breaking import (
    HIGH,
    LOW,
    Judged,
    Outcome,
    Rules,
    area,
    breaking_point,
    point_of,
    sides_of,
)
from nerfdiff.stability.silent import COLUMNS, Silent, silent_failures, silent_markdown, worst_of_each
from nerfdiff.stability.study import studies
from nerfdiff.stability.text import severity_text, to_markdown, training_markdown
from nerfdiff.stress.axes import stress_files

RULES = Rules(failed=0.1, clean=3.0, harm=0.5, frechet=2.0)
BOOTSTRAP = Bootstrap(resamples=200, level=0.95, seed=0)
SCENES = tuple("abcdefghij")
CLEAN = {(seed, scene): Outcome(20.0) for seed in (0, 1, 2) for scene in SCENES}


def outcomes(psnr=20.0, failed=0, verdict=None, **scenes) -> dict:
    """Three seeds of ten scenes of one PSNR, but for some; so many of the first scenes fell back."""
    own = {scene: scenes.get(scene, psnr) for scene in SCENES}
    status = {scene: "diverged" if number < failed else "ok" for number, scene in enumerate(SCENES)}
    return {(seed, scene): Outcome(own[scene], status[scene], verdict) for seed in (0, 1, 2) for scene in SCENES}


def judged(severity=1.0, own=None, none=None, baseline=None, **frechet) -> Judged:
    return Judged(severity, outcomes() if own is None else own, CLEAN, none or {}, baseline or {}, **frechet)


@pytest.mark.parametrize(
    ("case", "broken"),
    [
        (judged(), ""),
        (judged(own=outcomes(failed=1)), "a"),
        (judged(own=outcomes(17.01)), ""),
        (judged(own=outcomes(17.0)), "b"),
        (judged(own=outcomes(18.0), baseline=dict.fromkeys(SCENES, 18.1)), "b"),
        (judged(own=outcomes(18.0), none=outcomes(18.4)), ""),
        (judged(own=outcomes(18.0), none=outcomes(18.5)), "c"),
        (judged(frechet=[19.0], clean_frechet=[10.0]), ""),
        (judged(frechet=[20.0, 22.0], clean_frechet=[10.0]), "d"),
        (judged(own=outcomes(10.0, failed=5), none=outcomes(19.0), frechet=[9.0], clean_frechet=[1.0]), "abcd"),
    ],
)
def test_each_rule_breaks_where_it_says(case, broken):
    assert point_of(case, RULES, BOOTSTRAP).broken == broken


def curve(*values: float) -> list[Judged]:
    return [judged(float(severity), outcomes(value)) for severity, value in enumerate(values, 1)]


@pytest.mark.parametrize(
    ("values", "severity", "share"),
    [((20, 19, 17, 10), 3.0, 0.5), ((16, 20, 20), 1.0, 0.0), ((20, 20, 20), None, 1.0), ((20, 15, 20), 2.0, 1 / 3)],
)
def test_the_breaking_point_is_the_first_severity_that_is_broken(values, severity, share):
    found = breaking_point(HIGH, curve(*values), RULES, BOOTSTRAP)
    assert (found.severity, found.share, found.furthest) == (severity, share, float(len(values)))
    assert found.interval == (severity, severity)  # all scenes agree
    assert found.rules == ("b" if severity else "") and found.scene == ("a" if severity else None)


def test_scenes_that_differ_give_an_interval_and_the_first_that_fails_is_named():
    """Half the scenes break at severity 2 by far, the others at 4: the mean breaks between."""
    late = dict.fromkeys("fghij")
    along = [
        judged(1.0), judged(2.0, outcomes(14.6, **dict.fromkeys(late, 20.0))),
        judged(3.0, outcomes(14.0, **dict.fromkeys(late, 20.0))), judged(4.0, outcomes(10.0)),
    ]  # fmt: skip
    found = breaking_point(HIGH, along, RULES, BOOTSTRAP)
    assert found.severity == 3.0 and found.interval[0] == 2.0 and found.interval[1] == 4.0
    along = [judged(1.0, outcomes(20.0, j=-20.0))]
    assert breaking_point(HIGH, along, RULES, BOOTSTRAP).scene == "j"
    # an end beyond what was tested is none
    assert breaking_point(HIGH, along, RULES, BOOTSTRAP).interval == (1.0, None)


def test_the_mean_is_with_and_without_scenes_that_fell_back_and_lost_ones_are_counted():
    own = outcomes(20.0, failed=2, a=10.0, b=10.0) | {(0, "c"): Outcome(math.nan, "oom")}
    point = point_of(judged(own=own), RULES, BOOTSTRAP)
    assert point.failed == 7 and point.total == 30
    assert point.without_fallbacks == 20.0 and point.psnr.mean == pytest.approx((29 * 20 - 6 * 10) / 29)


@pytest.mark.parametrize(
    ("verdict", "failed", "silent"), [(None, 0, 3), ("ok", 0, 3), ("suspect: haze", 0, 0), ("ok", 1, 0)]
)
def test_a_broken_scene_is_silent_if_neither_status_nor_judge_tells(verdict, failed, silent):
    point = point_of(judged(own=outcomes(20.0, failed, verdict, a=16.0)), RULES, BOOTSTRAP)
    assert [(each.seed, each.scene) for each in point.failures] == [(0, "a"), (1, "a"), (2, "a")]
    assert {(each.rules, each.loss, each.harm) for each in point.failures} == {("b", 4.0, None)}
    assert len(point.silent) == silent and point.suspect == (30 if verdict and verdict != "ok" else 0)


def test_a_strategy_without_draws_is_compared_with_by_every_seed():
    none = {(0, scene): Outcome(20.0) for scene in SCENES}
    assert point_of(judged(own=outcomes(19.4), none=none), RULES, BOOTSTRAP).broken == "c"


def test_the_area_is_the_loss_divided_by_that_of_none():
    own = [point_of(each, RULES, BOOTSTRAP) for each in curve(19, 17)]
    none = [point_of(each, RULES, BOOTSTRAP) for each in curve(20, 18)]
    assert area(own, none) == pytest.approx(2.0)
    assert area(own, [point_of(judged(), RULES, BOOTSTRAP)]) is None and area([], none) is None


@pytest.mark.parametrize(
    ("severities", "neutral", "ordered", "sides"),
    [
        ([0.5, 0.85, 1.2, 2], 1.0, True, {LOW: [0.85, 0.5], HIGH: [1.2, 2]}),
        ([0.1, 0.3], 0.0, True, {HIGH: [0.1, 0.3]}),
        ([3, 1, 2], None, False, {HIGH: [3, 1, 2]}),
        ([5, 1], 8, True, {LOW: [5, 1]}),
    ],
)
def test_severities_are_counted_from_the_neutral_one_outwards(severities, neutral, ordered, sides):
    assert sides_of(severities, neutral, ordered) == sides


def write_run(
    home, strategy, psnr, stress=None, severity=None, neutral=None, seed=0, status="ok", verdict="ok", **more
):
    """The row and scores of a run of two scenes."""
    folder = f"{stress}{severity}{strategy}{seed}"
    words = [f"stress={stress or 'none'}", *([f"stress.severity={severity}"] if stress else [])]
    overrides = ["ckpt=demo", f"strategy={strategy}", f"seed={seed}", *words]
    row = ResultRow(
        run_id=folder, time=TIME, status=status, strategy=strategy, seed=seed, overrides=overrides, folder=folder,
        stress=stress, severity=severity, neutral=neutral, device="cpu",
    )  # fmt: skip
    append_row(home / "results.jsonl", row)
    if status in ("ok", "diverged"):
        path = home / folder / "scores" / strategy / "per_scene.csv"
        path.parent.mkdir(parents=True)
        fell = "ok" if status == "ok" else "diverged"
        lines = [f"{scene},4,{fell},{verdict},0,{psnr + shift}\n" for scene, shift in (("a", -0.1), ("b", 0.1))]
        path.write_text("scene,views,status,verdict,blank,psnr\n" + "".join(lines))


@pytest.fixture(scope="module")
def sweep(tmp_path_factory) -> list[Run]:
    """`focal` on both sides: ngd breaks at 1.5, and below at 0.7, where its run has no result; none at 2 alone."""
    home = tmp_path_factory.mktemp("sweep")
    for strategy, clean in (("none", 20.0), ("ngd", 21.0), ("copy_input", 12.0), ("mean_image", 13.0)):
        write_run(home, strategy, clean)
    for severity, none, ngd in ((0.85, 19.5, 20.5), (1.2, 19.0, 20.0), (1.5, 18.0, 17.0), (2.0, 12.0, 10.0)):
        for strategy, psnr in (("none", none), ("ngd", ngd)):
            verdict = "suspect: haze" if severity == 2.0 else "ok"
            write_run(home, strategy, psnr, "focal", severity, 1.0, verdict=verdict)
    write_run(home, "ngd", 0, "focal", 0.7, 1.0, status="oom")
    write_run(home, "none", 19, "focal", 0.7, 1.0)
    append_row(home / "results.jsonl", ResultRow(run_id="other", time=TIME, strategy="ngd", overrides=["ckpt=x"]))
    return read_runs(home / "results.jsonl")


def test_rows_of_a_sweep_give_the_verdicts_that_they_are_made_for(sweep):
    (study,) = studies(sweep, stress_files(), RULES, BOOTSTRAP)
    by = {verdict.strategy: verdict for verdict in study.verdicts}
    assert set(by) == {"none", "ngd"} and study.settings == ("ckpt=demo",) and study.clean["ngd"] == pytest.approx(21)
    low, high = by["ngd"].breaking
    assert (low.side, low.severity, low.rules) == (LOW, 0.7, "a") and (high.severity, high.rules) == (1.5, "bc")
    assert [each.severity for each in by["none"].breaking] == [None, 2.0]
    points = {point.severity: point for point in by["ngd"].points}
    assert list(points) == [0.7, 0.85, 1.2, 1.5, 2.0]
    assert (points[0.7].failed, points[0.7].total, math.isnan(points[0.7].psnr.mean)) == (2, 2, True)
    # at 1.5 nobody is told, at 2 the judge tells
    assert (by["ngd"].silent, by["ngd"].broken) == (2, 4) and (by["none"].silent, by["none"].broken) == (0, 2)
    assert by["none"].area == 1.0 and by["ngd"].area > 1.2


def test_seeds_in_folders_of_their_own_are_one_study(tmp_path):
    runs = []
    for seed in (0, 1):
        home = tmp_path / str(seed)
        for severity in (None, 1.5):
            own = {"stress": "focal", "severity": severity, "neutral": 1.0} if severity else {}
            write_run(home, "none", 20.0 - seed if severity is None else 15.0, seed=seed, **own)
        rows = read_runs(home / "results.jsonl")
        runs += [replace(r, row=replace(r.row, overrides=[*r.row.overrides, f"paths.runs_dir={home}"])) for r in rows]
    (study,) = studies(runs, stress_files(), RULES, BOOTSTRAP)
    (point,) = study.verdicts[0].points
    assert (study.settings, point.total, point.loss.mean) == (("ckpt=demo",), 4, pytest.approx(4.5))


def test_another_seed_as_a_stress_is_compared_with_the_seed_that_was_asked_for(tmp_path):
    """The run with seed 0 and stress=seed has a row of seed 1: it is not the clean run of seed 1."""
    for seed, psnr in ((0, 20.0), (1, 18.0)):
        write_run(tmp_path, "ngd", psnr, seed=seed)
    write_run(tmp_path, "ngd", 18.0, "seed", 1.0, seed=0)
    runs = read_runs(tmp_path / "results.jsonl")
    runs[-1] = replace(runs[-1], row=replace(runs[-1].row, seed=1))
    (study,) = studies(runs, stress_files(), RULES, BOOTSTRAP)
    assert study.verdicts[0].points[0].loss.mean == pytest.approx(2.0)


def test_silent_failures_are_listed_with_their_rules_and_what_the_stress_adds(sweep):
    (study,) = studies(sweep, stress_files(), RULES, BOOTSTRAP)
    found = silent_failures(study)
    assert [(each.words, each.strategy, each.failure.scene) for each in found] == [
        ("focal length ×1.5 true", "ngd", scene) for scene in "ab"
    ]
    assert {key: found[0].line()[key] for key in COLUMNS[:6]} == {
        "axis": "focal", "severity": 1.5, "strategy": "ngd", "seed": 0, "scene": "a", "rules": "bc",
    }  # fmt: skip
    # ngd is 1 dB better than none without stress, 1 dB worse with it
    failure = found[0].failure
    assert (failure.loss, failure.harm, failure.clean_harm) == pytest.approx((4.0, 1.0, -1.0))
    assert found[0].harmed_by_stress(RULES) and [each.failure.scene for each in worst_of_each(found)] == ["a"]
    text = silent_markdown(found, RULES)
    assert text.startswith("2 scenes by rule (b), 0 by rule (c) alone.")
    assert "| focal length ×1.5 true | 2 | 2 | ngd | ngd, a, seed 0 (bc) | 4.00 | 1.00 |" in text


@pytest.mark.parametrize(("clean", "by_stress"), [(20.0, True), (19.2, False), (19.0, False), (21.0, True)])
def test_a_strategy_that_is_worse_than_none_without_stress_too_is_told_apart(clean, by_stress):
    own = {(0, "a"): Outcome(18.4)}
    none, before = {(0, "a"): Outcome(19.0)}, {(0, "a"): Outcome(20.0)}
    case = Judged(1.0, own, {(0, "a"): Outcome(clean)}, none, {}, clean_none=before)
    (failure,) = point_of(case, RULES, BOOTSTRAP).failures
    each = Silent(stress_files()["focal"], 1.0, "ngd", failure, None)
    assert failure.rules == "c" and each.harmed_by_stress(RULES) == by_stress


def test_verdicts_are_written_as_tables_in_the_axis_own_units(sweep):
    text = to_markdown(
        studies(sweep, stress_files(), RULES, BOOTSTRAP), ["stress=halo stress.severity=4"], ["elevation: -10°"]
    )
    assert "**Silent failures: 2 of 6 broken scenes.**" in text
    assert (
        "| focal length | > ×0.7 true / ×2 true [×2 true, ×2 true] (b) | ×0.7 true [×0.7 true, ×0.7 true] (a) /" in text
    )
    assert "| focal length | ngd | ×0.7 true | – | – | – | 2 of 2 | 0 | a | 0 | – |" in text
    assert "Not run: 1 jobs, the first stress=halo" in text and "Left out: elevation: -10°." in text


@pytest.mark.parametrize(
    ("axis", "severity", "text"),
    [("precision", 2.0, "bf16"), ("elevation", 50.0, "50°"), ("mask_size", -1.0, "-1 px"), ("lr_planes", 10.0, "×10")],
)  # fmt: skip
def test_severities_are_told_in_their_units(axis, severity, text):
    assert severity_text(stress_files()[axis], severity) == text


def test_runs_of_training_are_a_table_with_those_that_did_not_end():
    def row(stress=None, severity=None, **more):
        return ResultRow(run_id="r", time=TIME, stress=stress, severity=severity, **more)

    rows = [
        row(psnr=20.1, held_out_loss=0.01, loss_spikes=0, nonfinite_grad_steps=0, grad_norm_p99=1.5),
        row(psnr=19.9, held_out_loss=0.02, loss_spikes=0, nonfinite_grad_steps=0, grad_norm_p99=1.5),
        row("train_lr", 30.0, psnr=15.0, loss_spikes=4, nonfinite_grad_steps=2, grad_norm_p99=9.0),
        row("train_lr", 10.0, psnr=12.0, loss_spikes=1, verdict="suspect: held-out renderings have 12.0 dB"),
        row("train_lr", 30.0, status="diverged", error="gradients", loss_spikes=6, nonfinite_grad_steps=20),
    ]
    text = training_markdown(rows, stress_files())
    assert "| none | – | 20.00 ± 0.14 | +0.00 | 0.0150 ± 0.0071 | 0.00 | 0.00 | 1.50 | – | 0 of 2 | 2 of 2 |" in text
    assert "| learning rate | ×30 | 15.00 | -5.00 | – | 5.00 | 11.00 | 9.00 | 1 of 2 | 0 of 2 | 1 of 2 |" in text
    assert "| learning rate | ×10 | 12.00 | -8.00 | – | 1.00 | – | – | 0 of 1 | 1 of 1 | 1 of 1 |" in text
