import dataclasses
import shlex
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from nerfdiff.cli import check_overrides, load_config
from nerfdiff.evaluation.measure import _command
from nerfdiff.evaluation.run import Orbit, RunSettings, Sheet


@pytest.mark.parametrize(
    ("words", "more"),
    [
        (["ckpt=demo", "data.root=/my data/cars", "data.image_size=[32,32]", "+budget={steps: 3}"], []),
        (["ckpt=demo", "sweep=strategies", "strategy=ngd", "seed=1"], ["hydra.mode=RUN"]),
    ],
)
@pytest.mark.parametrize("own", [None, "/tmp", "/home/a b/it's"])
def test_the_command_says_to_a_shell_what_the_job_was_told(words, more, own):
    sources = [
        ("pkg", "hydra.conf", "hydra"),
        ("file", "/conf", "main"),
        *([("file", own, "command-line")] * bool(own)),
    ]
    sources = [dict(zip(("schema", "path", "provider"), source, strict=True)) for source in sources]
    job = {"job": {"config_name": "distill"}, "overrides": {"task": words}, "runtime": {"config_sources": sources}}
    hydra, more = OmegaConf.create(job), [*more, *([f'hydra.searchpath=["file://{own}"]'] if own else [])]
    said = shlex.split(_command(hydra))
    assert said == ["python", "src/distill.py", *more, *words]
    check_overrides("distill", said[2:])


def test_an_evaluation_has_settings_of_its_own_and_not_the_config():
    words = [
        "ckpt=none",
        "data=srn_cars",
        "data.root=none",
        "prior=sphere",
        "minutes=3",
        "orbit.frames=5",
        "compile=unets",
    ]
    settings = RunSettings.of(load_config("evaluate", [*words, "metrics.batch=7", "results=a/rows.jsonl"]))
    assert (settings.dataset, settings.minutes, settings.compiled) == ("srn_cars/test", 3, True)
    assert (settings.orbit, settings.sheet) == (Orbit(5, 24, 1), Sheet(8, 2))
    assert settings.results == Path("a/rows.jsonl") and settings.scoring["batch"] == 7
    with pytest.raises(dataclasses.FrozenInstanceError):
        settings.seed = 1
