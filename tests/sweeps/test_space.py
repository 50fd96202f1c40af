"""Spaces of small configs that are composed by hand, and of this project's own."""

import random

import pytest
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from nerfdiff.cli import CONF
from nerfdiff.sweeps.space import Axis, Space, axes_of, space_of
from nerfdiff.utils.errors import ConfigError

NGD = {
    "name": "ngd",
    "prior": "${prior}",
    "teacher": {"steps": "${budget.steps}", "sampler": "ddim", "guidance": {"gamma": 1}},
}
CONFIGS = {"none": {"name": "none"}, "ngd": NGD, "sds": NGD | {"teacher": {"steps": "${budget.steps}"}}}
TOP = {"budget": {"steps": 4, "rays": 8, "views": 5}, "prior": {"views": "${budget.views}"}, "ckpt": "???"}


def composed(words):
    choices = dict(word.split("=") for word in words)
    taken = {"strategy": choices["strategy"], "budget": "small"}
    return OmegaConf.create(
        TOP
        | {"strategy": CONFIGS[choices["strategy"]], "hydra": {"runtime": {"choices": taken}, "x": "${budget.rays}"}}
    )


def space(*params, params_for=None, arguments=()):
    return space_of(params, params_for or {}, arguments, composed, lambda key: key == "strategy", ["budget", "prior"])


def keys(found):
    return {branch[0].words[0]: [axis.key for axis in branch[1:]] for branch in found.branches}


def test_an_axis_is_only_where_it_changes_something():
    found = space(
        "strategy=none,ngd,sds",
        "budget.steps=1,2",
        "budget.rays=1,2",  # only Hydra's own node mentions it
        "budget.views=1,2",  # by way of prior, which ngd and sds pick up
        "strategy.teacher.sampler=ddim,dpm",  # not of none and sds
        "ckpt=a,b",
    )
    assert keys(found) == {
        "strategy=none": ["ckpt"],
        "strategy=ngd": ["budget.steps", "budget.views", "strategy.teacher.sampler", "ckpt"],
        "strategy=sds": ["budget.steps", "budget.views", "ckpt"],
    }
    everything = list(found)
    assert len(found) == len(everything) == len(set(everything)) == 2 + 16 + 8
    assert found.groups == ("strategy",) and found.seeds == ()


def test_a_choice_that_is_a_mapping_needs_all_of_its_keys():
    found = space("strategy=ngd,sds", "strategy.teacher={},{sampler:dpm},{guidance:{gamma:2}}")
    by_strategy = {branch[0].words[0]: branch[1].words for branch in found.branches}
    assert by_strategy["strategy=sds"] == ("strategy.teacher={}",)
    assert len(by_strategy["strategy=ngd"]) == 3


def test_the_command_line_takes_the_place_of_choices():
    given = {"strategy": {"ngd": {"budget.steps": "7,8,9"}}, "budget": {"small": {"budget.views": "6,7"}, "big": {}}}
    found = space("strategy=none,ngd", "budget.steps=1,2", params_for=given)
    assert [axis.words for axis in found.branches[1]] == [
        ("strategy=ngd",),
        ("budget.steps=7", "budget.steps=8", "budget.steps=9"),
        ("budget.views=6", "budget.views=7"),
    ]
    found = space("strategy=none,ngd", "budget.steps=1,2", params_for=given, arguments=["budget.steps=3", "seed=0,1"])
    assert [axis.words for axis in found.branches[1]][1] == ("budget.steps=3",)
    assert found.seeds == ("seed=0", "seed=1")
    assert next(iter(found)) == ("strategy=none",)


def test_a_value_for_a_key_that_nothing_has_is_an_error():
    with pytest.raises(ConfigError, match=r"strategy\.teacher\.steeps=3"):
        space("strategy=none,ngd", arguments=["strategy.teacher.steeps=3"])
    assert keys(space("strategy=none,ngd", arguments=["strategy.teacher.sampler=ddim"])) == {
        "strategy=none": [],
        "strategy=ngd": ["strategy.teacher.sampler"],
    }
    assert keys(space("strategy=none", arguments=["+new=1", "~ckpt"])) == {"strategy=none": ["+new", "~ckpt"]}


def test_words_that_cannot_be_swept_over_are_named():
    with pytest.raises(ConfigError, match=r"a=interval\(0,1\)"):
        axes_of(["a=interval(0,1)"])
    with pytest.raises(ConfigError, match=r"a=\[1"):
        axes_of(["a=[1"])
    assert axes_of(["a=1,2", "b='x y'", "a=range(3)"]) == [Axis("a", ("a=0", "a=1", "a=2")), Axis("b", ("b='x y'",))]


def test_a_jobs_configuration_is_found_by_its_overrides():
    found = space("strategy=none,ngd", "budget.steps=1,2", "ckpt=a,b", "seed=0,1")
    configuration = ("strategy=ngd", "budget.steps=2", "ckpt=a")
    assert found.find(["seed=1", *reversed(configuration)]) == configuration
    assert found.branch_of(configuration) == 1 and found.named(configuration) == ["ngd"]
    assert found.find(["strategy=none", "ckpt=b"]) == ("strategy=none", "ckpt=b")
    for other in (["strategy=none"], ["strategy=ngd", "budget.steps=3", "ckpt=a"], [*configuration, "x=1"]):
        assert found.find(other) is None
    assert found.varied == {"strategy=none", "strategy=ngd", "budget.steps=1", "budget.steps=2", "ckpt=a", "ckpt=b"}


def test_every_branch_is_drawn_as_often():
    axes = (Axis("n", tuple(f"n={i}" for i in range(1000))), Axis("m", ("m=1", "m=2")))
    found = Space(((Axis("s", ("s=a",)),), (Axis("s", ("s=b",)), *axes)), ("s",))
    rng = random.Random(0)
    drawn = [found.draw(rng) for _ in range(1000)]
    assert 450 < sum(word[0] == "s=a" for word in drawn) < 550
    assert 450 < 2 * sum("m=1" in word for word in drawn) < 550
    assert len(found.untried([("s=a",)]).branches) == 1 and len(found.untried([drawn[-1], ("x",)]).branches) >= 1


def test_what_each_strategy_has_to_try():
    """Of this project's configs: no strategy is tried with settings that it does not read."""
    with initialize_config_dir(str(CONF), version_base="1.3"):
        sweep = compose("distill", ["ckpt=demo", "sweep=speed_accuracy", "budget=minutes"], return_hydra_config=True)
        sweeper = sweep.hydra.sweeper
        found = space_of(
            [f"{key}={value}" for key, value in sweeper.params.items()],
            sweeper.params_for,
            ["sweep=speed_accuracy", "budget=minutes", "ckpt=a,b"],
            lambda words: compose("distill", words, return_hydra_config=True),
            lambda key: (CONF / key).is_dir(),
            sweeper.indirect,
        )
    axes = {axes[0].words[0].partition("=")[2]: {axis.key for axis in axes if axis.varies} for axes in found.branches}
    every = {"uniform_samples", "importance_samples", "precision", "backend", "ckpt"}
    fitted = every | {"budget.steps", "budget.inner_steps", "budget.views"}
    sampled = {"strategy.teacher.sampler", "strategy.teacher.spacing"}
    assert axes == {
        "none": every,
        "cdm": every | {"budget.sampler_steps", "budget.deep_every", "strategy.sampler", "strategy.spacing"},
        "direct": fitted | sampled | {"budget.sampler_steps", "budget.deep_every"},
        "sds": fitted | {"strategy.coarse"},
        "stochastic": fitted | sampled | {"budget.sampler_steps"},
        "ngd": fitted | sampled | {"budget.deep_every", "strategy.coarse"},
        "ngd_current": fitted | sampled | {"budget.deep_every", "strategy.coarse"},
    }
    assert found.seeds == ("seed=0", "seed=1", "seed=2")
