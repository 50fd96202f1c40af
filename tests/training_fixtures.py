"""A small dataset and a small training run."""

import os
import subprocess
import sys
from pathlib import Path

import torch
from lightning import Callback

from data_fixtures import write_scene
from nerfdiff.cli import load_config
from nerfdiff.training import run as training
from nerfdiff.training.run import train

SRC = Path(__file__).parents[1] / "src"


def write_dataset(root: Path, scenes: int = 3, views: int = 5) -> Path:
    """SRN-layout cars with all three splits."""
    for split in ("train", "val", "test"):
        for scene in range(scenes):
            write_scene(root / f"cars_{split}" / f"scene{scene}", views, seed=scene, radius=4, truth=True)
    return root


def overrides(data: Path, run: Path, *more: str) -> list[str]:
    """Command-line overrides of a training run that takes a fraction of a second per step."""
    return [
        "model=tiny",
        "model.unet.channel_mult=[1,1]",
        "model.unet.attention_downsampling=[2]",
        "model.field.channels=4",
        "model.render.uniform_samples=4",
        "model.render.importance_samples=4",
        "trainer=cpu",
        "trainer.max_steps=6",
        "trainer.log_every_n_steps=1",
        "validation_every=3",
        "validation_times=[0.5]",
        f"data.root={data}",
        f"data.cache_dir={data / 'cache'}",
        "data.image_size=[10,14]",
        "data.source_view=0",
        "data.batch_size=4",
        "data.num_workers=0",
        "data.val_scenes=2",
        "data.val_targets=2",
        "optimizer.warmup_steps=2",
        "callbacks.previews.sampler.steps=2",
        "callbacks.last.every_n_steps=2",
        "callbacks.progress=null",
        "threads=1",
        f"paths.run_dir={run}",
        *more,
    ]


def run_training(data: Path, run: Path, *more: str) -> dict[str, float]:
    """Train in this process."""
    return train(load_config("train", overrides(data, run, f"paths.output_dir={run}", *more)))


def train_with(monkeypatch, callback: Callback, data: Path, run: Path, *more: str) -> dict[str, float]:
    """One run with one more callback, before the checkpoints'."""
    build = training.instantiate

    def instantiate(config, **options):
        if "callbacks" in options:
            options["callbacks"] = [callback, *options["callbacks"]]
        return build(config, **options)

    with monkeypatch.context() as patch:
        patch.setattr(training, "instantiate", instantiate)
        return run_training(data, run, *more)


def command(data: Path, run: Path, *more: str) -> list[str]:
    """The same as a command."""
    return [sys.executable, str(SRC / "train.py"), *overrides(data, run, *more)]


def train_to_evaluate(data: Path, run: Path) -> None:
    """A checkpoint for `evaluation_overrides`."""
    run_training(data, run, "trainer.max_steps=2", "data.image_size=[20,28]")


def evaluation_overrides(data: Path, run: Path, out: Path, *more: str) -> list[str]:
    """What evaluate.py and distill.py share in tests, on a checkpoint of `train_to_evaluate`."""
    return [
        f"ckpt={run}",
        f"data.root={data}",
        "data.cache=false",
        "data.image_size=[20,28]",
        "data.source_view=0",
        "data.num_workers=0",
        f"paths.output_dir={out}",
        "threads=1",
        *more,
    ]


def run_command(data: Path, run: Path, *more: str) -> subprocess.CompletedProcess:
    done = subprocess.run(command(data, run, *more), capture_output=True, text=True, env=environment(), timeout=300)
    assert done.returncode == 0, done.stderr[-3000:]
    return done


def environment() -> dict[str, str]:
    return os.environ | {"OMP_NUM_THREADS": "1", "CUDA_VISIBLE_DEVICES": ""}


def last_checkpoint(run: Path) -> dict:
    return torch.load(run / "checkpoints" / "last.ckpt", weights_only=True)


def assert_same_state(first: dict, second: dict) -> None:
    """Weights raw and averaged, optimizer and schedule, bit for bit."""
    for key in ("state_dict", "current_model_state"):
        assert first[key].keys() == second[key].keys()
        for name, value in first[key].items():
            assert torch.equal(value, second[key][name]), name
    assert first["global_step"] == second["global_step"]
    assert first["lr_schedulers"] == second["lr_schedulers"]
    assert first["averaging_state"] == second["averaging_state"]
    moments, others = (checkpoint["optimizer_states"][0]["state"] for checkpoint in (first, second))
    assert moments.keys() == others.keys()
    for index, state in moments.items():
        for name, value in state.items():
            assert torch.equal(value, others[index][name]), (index, name)
