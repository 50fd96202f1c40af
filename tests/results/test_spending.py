"""What scenes were given, on rows whose numbers are known."""

import csv

import pytest

from chart_fixtures import result
from nerfdiff.results.frame import Run
from nerfdiff.results.spending import correlations, is_stated, regrets, spending, write_spending
from nerfdiff.utils.errors import ConfigError, DataError

BASE = {"a": 20.0, "b": 22.0, "c": 24.0, "d": 26.0}  # "a" is the hardest


def run(folder, name: str, strategy: str, psnr: dict, seconds: dict, *words: str, seed: int = 0, **values) -> Run:
    """A run that left these scores; what it spent stands there too."""
    scores = folder / name / "scores" / strategy / "per_scene.csv"
    scores.parent.mkdir(parents=True)
    lines = [f"{s},ok,schedule,{seconds.get(s, '')},8,100,4,{value}\n" for s, value in psnr.items()]
    heading = "scene,status,stopped_by,distill,denoiser_calls,field_queries,steps,psnr\n"
    scores.write_text(heading + "".join(lines))
    overrides = [f"strategy={strategy}", f"seed={seed}", *words]
    calls = 0 if strategy == "none" else 10
    more = {"strategy": strategy, "folder": name, "overrides": overrides, "denoiser_calls": calls} | values
    return Run(result(seed=seed, **more), folder)


def study(folder) -> list[Run]:
    """A single-image NeRF, two fixed budgets and an adaptive one of the same strategy."""
    small = {s: psnr + 1 for s, psnr in BASE.items()}
    large = small | {"a": 23.0, "b": 23.02}  # pays for the hardest alone: "b" gains less than the tolerance
    adaptive = small | {"a": 22.5}
    return [
        run(folder, "base", "none", BASE, {}),
        run(folder, "small", "ngd", small, dict.fromkeys(BASE, 5.0), "budget.steps=4"),
        run(folder, "large", "ngd", large, dict.fromkeys(BASE, 20.0), "budget.steps=16"),
        run(folder, "own", "ngd", adaptive, {"a": 15.0, "b": 9.0, "c": 6.0, "d": 4.0}, "budget=adaptive"),
    ]


def test_spending_is_read_with_how_hard_scenes_are(tmp_path):
    spent = spending(study(tmp_path))
    assert {line.configuration for line in spent} == {
        "ngd budget.steps=4", "ngd budget.steps=16", "ngd budget=adaptive"
    }  # fmt: skip
    (own,) = [line for line in spent if line.scene == "a" and "adaptive" in line.configuration]
    assert (own.base_psnr, own.quality, own.seconds, own.steps, own.stopped_by) == (20.0, 22.5, 15.0, 4.0, "schedule")
    with pytest.raises(ConfigError, match="fid"):
        spending(study(tmp_path / "again"), "fid")


def test_spearman_is_one_where_the_hardest_get_most(tmp_path):
    runs = study(tmp_path)
    found = {line.configuration: line for line in correlations(spending(runs))}
    assert found["ngd budget=adaptive"].rho == pytest.approx(1.0) and found["ngd budget=adaptive"].n == 4
    assert found["ngd budget.steps=4"].rho is None  # all the same: there is no order
    other = {"a": 1.0, "b": 2.0, "c": 4.0, "d": 3.0}
    more = run(tmp_path, "second", "ngd", BASE, other, "budget=adaptive", seed=1)
    (line,) = [line for line in correlations(spending([*runs, more])) if "adaptive" in line.configuration]
    # of the means over both seeds, 8, 5.5, 5 and 3.5
    assert line.n == 4 and line.rho == pytest.approx(1.0)
    (line,) = correlations(spending([runs[0], more]))
    assert line.rho == pytest.approx(-0.8)


@pytest.mark.parametrize("missing", ["none", "split"])
def test_without_the_single_image_nerf_of_these_scenes_nothing_is_hard(tmp_path, missing):
    runs = study(tmp_path)
    runs = runs[1:] if missing == "none" else [*runs[1:], run(tmp_path, "x", "none", BASE, {}, split_sha256="other")]
    assert {line.base_psnr for line in spending(runs)} == {None}
    assert all((line.n, line.rho) == (0, None) for line in correlations(spending(runs)))


def test_regret_is_to_the_cheapest_budget_that_is_good_enough(tmp_path):
    lost = regrets(spending(study(tmp_path)), lambda name: "adaptive" in name)
    assert [(line.scene, line.best.split("=")[-1]) for line in lost] == [
        ("a", "16"),
        ("b", "4"),
        ("c", "4"),
        ("d", "4"),
    ]
    assert [line.quality for line in lost] == pytest.approx([0.5, 0, 0, 0])
    assert [line.seconds for line in lost] == pytest.approx([-5.0, 4.0, 1.0, -1.0])
    exact = regrets(spending(study(tmp_path / "again")), lambda name: "adaptive" in name, tolerance=0.0)
    assert exact[1].best.endswith("16") and exact[1].quality == pytest.approx(0.02)


def test_strategies_and_seeds_are_compared_with_their_own(tmp_path):
    runs = study(tmp_path)
    runs += [run(tmp_path, "sds", "sds", BASE, dict.fromkeys(BASE, 1.0), "budget=adaptive")]
    runs += [run(tmp_path, "seed", "ngd", BASE, dict.fromkeys(BASE, 1.0), "budget=adaptive", seed=7)]
    assert {(line.configuration, line.seed) for line in regrets(spending(runs), lambda n: "adaptive" in n)} == {
        ("ngd budget=adaptive", 0)
    }


def test_files_say_what_was_found(tmp_path):
    path = write_spending(tmp_path, study(tmp_path / "runs"))
    text = path.read_text()
    assert "ngd budget=adaptive | 4 | 4.0 | 7.5 | 15.0 | 1.00 | 0.00 | schedule 4" in text
    assert "ngd budget=adaptive | 4 | +0.12 | +0.50 | -0.25 | +4.00" in text
    with open(tmp_path / "spending.csv", newline="") as file:
        lines = list(csv.DictReader(file))
    assert len(lines) == 12 and lines[-1]["scene"] == "d" and float(lines[-1]["seconds"]) == 4.0
    with open(tmp_path / "regret.csv", newline="") as file:
        assert [line["scene"] for line in csv.DictReader(file)] == list(BASE)


def test_damaged_scores_are_named(tmp_path):
    runs = study(tmp_path)
    (tmp_path / "small/scores/ngd/per_scene.csv").write_text("scene,psnr\na,many\n")
    with pytest.raises(DataError, match="small/scores"):
        spending(runs)
    assert len(spending([runs[0], runs[3], Run(result(strategy="ngd", folder="gone"), tmp_path)])) == 4


@pytest.mark.parametrize(
    ("words", "stated"),
    [(["budget=adaptive"], True), (["+quality=good"], True), (["seconds_per_scene=5"], True), (["budget=fast"], False)],
)
def test_what_a_person_states_is_told_from_fixed_budgets(words, stated, tmp_path):
    assert is_stated(Run(result(overrides=words), tmp_path)) is stated
