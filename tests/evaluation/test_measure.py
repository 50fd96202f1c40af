import shlex

import pytest
from omegaconf import OmegaConf

from nerfdiff.cli import check_overrides
from nerfdiff.evaluation.measure import _command


@pytest.mark.parametrize(
    ("words", "more"),
    [
        (["ckpt=demo", "data.root=/my data/cars", "data.image_size=[32,32]", "+budget={steps: 3}"], []),
        (["ckpt=demo", "sweep=strategies", "strategy=ngd", "seed=1"], ["hydra.mode=RUN"]),
    ],
)
def test_the_command_says_to_a_shell_what_the_job_was_told(words, more):
    hydra = OmegaConf.create({"job": {"config_name": "distill"}, "overrides": {"task": words}})
    said = shlex.split(_command(hydra))
    assert said == ["python", "src/distill.py", *more, *words]
    check_overrides("distill", said[2:])
