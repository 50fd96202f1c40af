import subprocess
import sys
from pathlib import Path

import pytest

from nerfdiff.cli import CONF, check_overrides, load_config
from nerfdiff.errors import ConfigError

SRC = Path(__file__).parents[1] / "src"


@pytest.mark.parametrize("model", ["tiny", "small", "base", "large"])
@pytest.mark.parametrize("data", ["srn_cars", "srn_chairs"])
@pytest.mark.parametrize("conditioning", ["rendered", "concat", "cross_attention"])
def test_every_choice_composes(model, data, conditioning):
    cfg = load_config("train", [f"model={model}", f"data={data}", f"conditioning={conditioning}"])
    assert (cfg.model.name, cfg.data.name, cfg.conditioning.name) == (model, data, conditioning)
    assert cfg.optimizer.lr == (2e-5 if model in ("base", "large") else 5e-4)


@pytest.mark.parametrize("experiment", sorted(p.stem for p in (CONF / "experiment").glob("*.yaml")))
def test_every_experiment_composes_and_is_not_ignored(experiment):
    cfg = load_config("train", [f"experiment={experiment}"])
    assert cfg.run_name == experiment


@pytest.mark.parametrize("trainer", ["auto", "cpu", "gpu", "ddp"])
def test_every_trainer_composes(trainer):
    assert load_config("train", [f"trainer={trainer}"]).trainer.max_steps == 500_000


def test_the_papers_numbers():
    cfg = load_config("train", [])
    assert (cfg.losses.lambda_ic, cfg.losses.lambda_dm) == (1, 1)
    assert (cfg.optimizer.lr, cfg.callbacks.ema.decay, cfg.data.batch_size) == (2e-5, 0.9999, 32)
    assert (cfg.model.field.channels, cfg.model.field.hidden) == (48, 64)
    assert (cfg.model.render.uniform_samples, cfg.model.render.importance_samples) == (64, 64)
    assert load_config("evaluate", ["ckpt=demo", "strategy=cdm"]).strategy.steps == 64


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("modle=tiny", ["modle is not a key", "did you mean model?", "conditioning"]),
        ("optimizer.lrr=1", ["optimizer.lrr is not a key", "optimizer.lr?", "warmup_steps"]),
        ("model.unet.wdith=64", ["model.unet.width?", "channel_mult"]),
        ("seed.x=1", ["seed.x is not a key", "it is a value"]),
        ("model=huge", ["base", "large", "small", "tiny"]),
        ("trainer.max_steps=many", ["trainer.max_steps takes int", "'many'"]),
        ("trainer.max_steps=1.5", ["takes int"]),
        ("optimizer.lr=fast", ["optimizer.lr takes int or float"]),
        ("channels_last=3", ["channels_last takes bool"]),
        ("trainer.max_steps=true", ["takes int"]),
        ("trainer.max_steps=10,many", ["takes int", "'many'"]),
        ("a=[1,2", ["a=[1,2"]),
    ],
)
def test_what_is_wrong_is_said_with_what_is_right(override, words):
    with pytest.raises(ConfigError) as error:
        check_overrides("train", [override])
    assert all(word in str(error.value) for word in words), str(error.value)


@pytest.mark.parametrize(
    "override",
    ["+trainer.fast_dev_run=true", "~logger", "optimizer.lr=1", "data.eval_scenes=3", "callbacks.previews=null",
     "model=tiny,base", "seed=1,2,3", "run_name=${data.name}", "hydra.job.chdir=false", "threads=2"],
)  # fmt: skip
def test_what_is_right_passes(override):
    check_overrides("train", [override])


def run(*arguments: str) -> subprocess.CompletedProcess:
    return subprocess.run([sys.executable, *arguments], capture_output=True, text=True, timeout=120)


def test_the_large_model_composes_on_any_machine():
    done = run(str(SRC / "train.py"), "model=large", "data=srn_cars", "--cfg", "job")
    assert done.returncode == 0
    assert "width: 256" in done.stdout


def test_a_wrong_key_ends_the_command_with_one_line():
    done = run(str(SRC / "train.py"), "modle=large")
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1 and done.stderr.startswith("error: modle is not a key")
