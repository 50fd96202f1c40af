import subprocess
import sys
from pathlib import Path

import pytest
from hydra.errors import InstantiationException
from hydra.utils import instantiate
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from torch.utils.data import DataLoader, Dataset

from nerfdiff.cli import CONF, check_overrides, entry_point, explain, load_config
from nerfdiff.utils.errors import ConfigError, DataError

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
    assert experiment in cfg.run_name


@pytest.mark.parametrize("trainer", ["auto", "cpu", "gpu", "ddp"])
def test_every_trainer_composes(trainer):
    cfg = load_config("train", [f"trainer={trainer}"])
    assert cfg.trainer.max_steps == 500_000
    OmegaConf.resolve(cfg.callbacks.previews.sampler)


STRATEGIES, BUDGETS = (sorted(p.stem for p in (CONF / group).glob("*.yaml")) for group in ("strategy", "budget"))
WITHOUT_A_MODEL, WITHOUT_A_SAMPLER = ("copy_input", "mean_image"), ("none", "sds", "sds_fresh")


@pytest.mark.parametrize("strategy", [name for name in STRATEGIES if name not in WITHOUT_A_MODEL])
def test_every_strategy_composes_with_the_fast_budget(strategy):
    cfg = load_config("distill", ["ckpt=demo", f"strategy={strategy}", "budget=fast"])
    method = instantiate(cfg.strategy)
    settings = method.teacher.keywords if strategy not in ("none", "cdm") else cfg.strategy
    if strategy not in WITHOUT_A_SAMPLER:
        assert (settings["sampler"], settings["spacing"]) == ("dpmpp_2m", "uniform_lambda")
        assert settings.get("sampler_steps", settings["steps"]) == 16
    if "teacher" in cfg.strategy:
        inner_steps = 1 if strategy == "sds_fresh" else 64
        assert (method.fit.inner_steps, method.fit.guidance_uniform_samples) == (inner_steps, 32)
    assert settings.get("at_full_guidance", "nothing") == "nothing"


def test_budgets_have_the_same_keys_and_each_is_read():
    budgets = [OmegaConf.load(CONF / f"budget/{name}.yaml") for name in BUDGETS if name != "adaptive"]
    assert len({frozenset(budget) for budget in budgets}) == 1
    adaptive = load_config("distill", ["ckpt=demo", "budget=adaptive"]).budget
    assert {key for key in adaptive if key != "quality"} >= set(budgets[0])
    read = "".join(path.read_text() for path in CONF.rglob("*.yaml"))
    assert all(f"${{budget.{key}}}" in read for key in budgets[0])


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
        ("modle=tiny", ["modle is not a key; did you mean model? --cfg job shows all"]),
        ("optimizer.lrr=1", ["optimizer.lrr is not a key", "optimizer.lr?"]),
        ("model.unet.wdith=64", ["model.unet.width?"]),
        ("optimizer.frobnicate=1", ["is not a key. Keys of optimizer: ", "warmup_steps"]),
        ("model=smal", ["there is no model/smal; did you mean small? Choices: base"]),
        ("seed.x=1", ["seed.x is not a key", "it is a value"]),
        ("model=huge", ["base", "large", "small", "tiny"]),
        ("trainer.max_steps=many", ["trainer.max_steps takes int", "'many'"]),
        ("trainer.max_steps=1.5", ["takes int"]),
        ("optimizer.lr=fast", ["optimizer.lr takes int or float"]),
        ("resume=3", ["resume takes bool"]),
        ("trainer.max_steps=true", ["takes int"]),
        ("trainer.max_steps=10,many", ["takes int", "'many'"]),
        ("a=[1,2", ["a=[1,2"]),
        ("model=tiny,huge", ["no model/huge", "base", "large", "small", "tiny"]),
        ("hydra/launcher=nope", ["no hydra/launcher/nope", "basic"]),
        ("logger=null", ["logger takes tensorboard, got null", "~logger"]),
        ("logger=tensorboard,null", ["logger takes tensorboard, got null"]),
        ("trainer=null", ["trainer takes auto or cpu or ddp or gpu, got null"]),
        ("optimizer=1", ["optimizer takes paper or small, got 1"]),
        ("model.unet.channel_mult=3", ["model.unet.channel_mult takes a list (default [1, 1, 2, 3, 4]), got 3"]),
        ("model.unet.channel_mult=[1,2],3", ["takes a list", "got 3"]),
        ("model.unet=wide", ["model.unet takes a mapping (keys width, patch, channel_mult", "'wide'"]),
        ("trainer.max_steps=[10]", ["takes int"]),
    ],
)
def test_what_is_wrong_is_said_with_what_is_right(override, words):
    with pytest.raises(ConfigError) as error:
        check_overrides("train", [override])
    assert all(word in str(error.value) for word in words), str(error.value)


@pytest.mark.parametrize(
    "override",
    ["+trainer.fast_dev_run=true", "~logger", "optimizer.lr=1", "data.eval_scenes=3", "callbacks.previews=null",
     "model=tiny,base", "seed=1,2,3", "run_name=${data.name}", "hydra.job.chdir=false", "threads=2",
     "hydra/sweeper=basic", "hydra/job_logging=stdout", "hydra.verbose=lightning", "++trainer.x=1", "++seed=x",
     "model=glob(*)", "optimizer.lr=interval(0,1)", "seed=range(1,4)", "model.unet.channel_mult=[1,2]",
     "model.unet={width:64}", "callbacks={previews:null}", "data.image_size=32", "data.image_size=[32,64]",
     "~logger=tensorboard"],
)  # fmt: skip
def test_what_is_right_passes(override):
    check_overrides("train", [override])


def test_a_value_must_suit_every_choice_of_a_sweep():
    check_overrides("evaluate", ["strategy=cdm", "strategy.steps=8"])
    with pytest.raises(ConfigError, match=r"strategy\.steps is not a key"):
        check_overrides("evaluate", ["strategy=cdm,none", "strategy.steps=8"])


def test_running_without_a_logger():
    assert "logger" not in load_config("train", ["~logger"])


class Demanding:
    """Constructed from a config, it finds fault."""

    def __init__(self, fault: str):
        if fault == "user":
            try:
                Path("/nowhere/at/all").read_bytes()
            except OSError as error:
                raise DataError("data.root=/nowhere does not exist; set data.root") from error
        raise TypeError("a fault\nof two lines")


@pytest.mark.parametrize(
    ("node", "message"),
    [
        ({"fault": "user"}, "data.root=/nowhere does not exist; set data.root"),
        ({"fault": "other"}, "part: Error in call to target 'test_cli.Demanding': TypeError: a fault of two lines"),
        ({"fault": "???"}, "part.fault must be given: add part.fault=<value>"),
    ],
)
@pytest.mark.parametrize("nested", [False, True])
def test_what_a_constructor_raised_is_explained(node, message, nested):
    node = {"_target_": f"{__name__}.Demanding"} | node
    key = "part"
    if nested:
        node, key = {"_target_": "builtins.dict", "inner": node}, "part.inner"
    with pytest.raises((InstantiationException, OmegaConfBaseException)) as error:
        instantiate(OmegaConf.create({"part": node}).part)
    expected = message.replace("part", key).replace("test_cli", __name__)
    assert explain(error.value) == expected


def test_a_missing_class_is_explained():
    with pytest.raises(InstantiationException) as error:
        instantiate({"_target_": "nerfdiff.nothing.Here"})
    message = explain(error.value)
    assert "nerfdiff.nothing.Here" in message and "\n" not in message


class Damaged(Dataset):
    def __len__(self):
        return 1

    def __getitem__(self, index):
        try:
            raise DataError("the cause")
        except DataError as error:
            raise DataError("a.png is damaged: delete it\nand render it again") from error


def test_what_a_worker_raised_is_explained():
    with pytest.raises(DataError) as error:
        next(iter(DataLoader(Damaged(), num_workers=1)))
    assert "Traceback" in str(error.value)
    assert explain(error.value) == "a.png is damaged: delete it\nand render it again"


def test_other_errors_keep_their_traceback():
    assert explain(KeyError("x")) is None
    bug = ValueError("of the program")
    bug.__cause__ = DataError("handled before")
    assert explain(bug) is None


def test_config_errors_are_explained():
    cfg = load_config("evaluate", [])
    with pytest.raises(OmegaConfBaseException) as error:
        cfg.ckpt  # noqa: B018
    assert explain(error.value) == "ckpt must be given: add ckpt=<value>"
    with pytest.raises(OmegaConfBaseException) as error:
        cfg.data.rooot  # noqa: B018
    assert explain(error.value) == "data.rooot: Key 'rooot' is not in struct"


def test_a_command_ends_with_the_explanation(monkeypatch, tmp_path):
    arguments = ["hydra/job_logging=none", "hydra/hydra_logging=none", "hydra.output_subdir=null"]
    monkeypatch.setattr(sys, "argv", ["evaluate.py", *arguments, f"hydra.run.dir={tmp_path}"])
    monkeypatch.setattr("nerfdiff.cli.quieten", lambda: None)  # the loggers are those of all tests
    command = entry_point("evaluate")(lambda cfg: cfg.ckpt)
    monkeypatch.delenv("HYDRA_FULL_ERROR", raising=False)
    with pytest.raises(SystemExit) as end:
        command()
    assert end.value.code == "error: ckpt must be given: add ckpt=<value>"


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


@pytest.mark.parametrize("data", ["srn_cars", "abo", "clevr3d"])
@pytest.mark.parametrize("size", ["32", "[30,40]", "null"])
def test_image_sizes_may_be_one_side_or_two(data, size):
    check_overrides("train", [f"data={data}", f"data.image_size={size}"])
    with pytest.raises(ConfigError, match=r"data\.image_size takes"):
        check_overrides("train", ["data=abo", "data.image_size=wide"])
