"""The configurations of sweep=stability, by a composed config that is made by hand where composing is slow."""

from itertools import pairwise

import pytest
from omegaconf import OmegaConf

from nerfdiff.cli import CONF, load_config
from nerfdiff.stress.axes import stress_files
from nerfdiff.sweeps.stress_space import StressSpace, acts, severities_of
from nerfdiff.utils.errors import ConfigError

CONFIGS = {}


def compose(words: list[str]):
    """As Hydra would, of the strategy alone."""
    strategy = next((word for word in words if word.startswith("strategy=")), "strategy=none")
    if strategy not in CONFIGS:
        CONFIGS[strategy] = load_config("distill", ["ckpt=demo", "budget=stress", strategy])
        OmegaConf.update(CONFIGS[strategy], "hydra", {}, force_add=True)
    return CONFIGS[strategy]


def space(*arguments: str, severities: str = "quick"):
    made = StressSpace("distill", severities, ["copy_input", "mean_image"])
    return made(["strategy=none,direct,ngd_current", "seed=0,1"], ["ckpt=demo", *arguments], compose)


def test_every_axis_is_there_with_its_severities_and_the_strategies_it_acts_on():
    jobs = list(space())
    by_axis: dict[str, list] = {}
    for job in jobs:
        words = dict(word.split("=", 1) for word in job)
        by_axis.setdefault(words["stress"], []).append((words.get("stress.severity"), words["strategy"]))
    missing = {"shape", "prior_training"}  # which need folders
    axes = {axis for axis, stress in stress_files().items() if stress.where == "distill" and axis not in missing}
    assert set(by_axis) == {"none", *axes} and len(set(jobs)) == len(jobs)
    assert [strategy for _, strategy in by_axis["none"]] == [
        "none",
        "direct",
        "ngd_current",
        "copy_input",
        "mean_image",
    ]
    assert set(by_axis["noise"]) == {(s, of) for s in ("0.12", "0.38") for of in ("none", "direct", "ngd_current")}
    assert {of for _, of in by_axis["lr_planes"]} == {"direct", "ngd_current"}
    assert {of for _, of in by_axis["guidance_weight"]} == {"ngd_current"}
    assert all("ckpt=demo" in job for job in jobs)


def test_the_harshest_severities_of_all_axes_come_first_so_that_minutes_cover_every_axis():
    stresses = [dict(word.split("=", 1) for word in job)["stress"] for job in space()]
    first = list(dict.fromkeys(stresses))
    assert stresses[0] == "none" and len(set(first)) == len(first)
    seen, again = set(), None
    for at, (before, axis) in enumerate(pairwise(stresses)):
        if axis != before and axis in seen:
            again = again or at
        seen.add(axis)
    assert set(stresses[: again + 1]) == set(first)


def test_a_job_is_found_by_its_overrides_and_seeds_are_swept():
    found = space()
    job = list(found)[40]
    assert found.find([*reversed(job), "seed=1"]) == job and found.seeds == ("seed=0", "seed=1")
    assert found.named(job)[1].isidentifier()


def test_arguments_choose_axes_strategies_and_seeds():
    jobs = list(space("stress=focal,noise", "strategy=ngd", "seed=3", "data.eval_scenes=1"))
    words = [dict(word.split("=", 1) for word in job) for job in jobs]
    assert {each["stress"] for each in words} == {"none", "focal", "noise"}
    assert {each["strategy"] for each in words if each["stress"] != "none"} == {"ngd"}
    assert {each["data.eval_scenes"] for each in words} == {"1"}


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["stress=fokal"], "stress=fokal: choose among alien_views"),
        (["stress=train_lr"], "stress=train_lr: choose among"),
        (["stress.severity=1,2"], "leave it out"),
        (["budget.steps=1,2"], "budget.steps has several values"),
    ],
)
def test_what_the_sweep_cannot_sweep_over_is_refused(words, message):
    with pytest.raises(ConfigError, match=message):
        space(*words)


@pytest.mark.parametrize(
    ("axis", "severities"),
    [
        ("focal", [0.5, 2.0, 0.7, 1.5, 0.85, 1.2]),
        ("views", [1, 100, 2, 50, 5, 25, 10]),
        ("diffusion_steps", [1, 64, 2, 32, 16, 8]),
        ("ambiguous", [3, 2, 1]),
    ],
)
def test_severities_go_from_the_harshest_of_either_side_inwards_without_the_neutral_one(axis, severities):
    found = severities_of(stress_files()[axis], compose(["strategy=ngd_current"]), "severities")
    assert found == (severities, {})


def test_an_axis_whose_folder_is_there_runs_with_baselines_of_its_own_scenes_and_else_is_left_out(tmp_path, caplog):
    config = compose(["strategy=ngd_current"]).copy()
    config.paths.kaykit_dir = str(tmp_path)
    found, missing = severities_of(stress_files()["shape"], config, "quick")
    assert found == [1] and missing == {2: "data/procedural/chairs_64"}
    caplog.set_level("INFO")
    made = StressSpace("distill", "quick", ["copy_input"])(["strategy=ngd"], ["stress=shape"], lambda words: config)
    jobs = [dict(word.split("=", 1) for word in job) for job in made]
    assert [job["strategy"] for job in jobs if job["stress"] == "shape"] == ["ngd", "copy_input"]
    assert "left out: shape at 2: there is no data/procedural/chairs_64" in caplog.text


def test_training_has_its_own_stresses_and_no_strategies():
    made = StressSpace("train", "quick", [])(["strategy=none", "seed=0"], ["x=1"], lambda words: train_config())
    words = [dict(word.split("=", 1) for word in job) for job in made]
    assert {each["stress"] for each in words} > {"none", "train_lr", "train_white_images"}
    assert not any("strategy" in each for each in words)


def train_config():
    return OmegaConf.create({"data": {"batch_size": 6}, "hydra": {}})


def test_a_stress_acts_where_one_of_its_keys_is():
    seed = stress_files()["seed"]
    assert not acts(seed, compose(["strategy=none"])) and acts(seed, compose(["strategy=ngd_current"]))


def test_the_full_sweep_has_every_strategy_that_makes_a_field():
    """`stability=full` sweeps all strategies that make fields, without the variants of one."""
    no_field, variants = {"cdm", "copy_input", "mean_image"}, {"ngd_equation", "ngd_first", "sds_fresh"}
    known = {path.stem for path in (CONF / "strategy").glob("*.yaml")} - no_field - variants
    asked = OmegaConf.load(CONF / "stability" / "full.yaml").hydra.sweeper.params.strategy
    assert set(asked.split(",")) == known
