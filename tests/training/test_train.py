import re
import resource
import signal
import subprocess
import time

import pytest
import torch
from lightning import Callback
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.plugins.custom_scalar import layout_pb2
from tensorboard.plugins.hparams import api_pb2, metadata

from nerfdiff.checkpoint import load_model
from nerfdiff.utils.errors import CheckpointError, ConfigError, DataError
from training_fixtures import (
    assert_same_state,
    command,
    environment,
    last_checkpoint,
    run_command,
    run_training,
    train_with,
    write_dataset,
)


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return write_dataset(tmp_path_factory.mktemp("data"))


@pytest.fixture(scope="module")
def whole(data, tmp_path_factory):
    """An uninterrupted run."""
    run = tmp_path_factory.mktemp("whole")
    return run, run_training(data, run)


def test_a_run_leaves_what_a_person_looks_for(whole):
    run, metrics = whole
    assert (run / "config.yaml").is_file()
    assert (run / "checkpoints" / "last.ckpt").is_file() and (run / "checkpoints" / "best.ckpt").is_file()
    assert sorted(p.name for p in (run / "previews").iterdir()) == ["step_0000003.png", "step_0000006.png"]
    assert any((run / "tensorboard").glob("events.*"))
    assert {"val/psnr", "val/loss_dm", "train/loss_ic", "train/loss_dm", "train/grad_norm"} <= metrics.keys()


def test_a_run_shows_itself_in_tensorboard(whole):
    """Settings and status for the HPARAMS tab, the config as text, pictures, and charts of tags that there are."""
    run, metrics = whole
    events = EventAccumulator(str(run / "tensorboard")).Reload()
    said = events.PluginTagToContent(metadata.PLUGIN_NAME)
    assert metadata.EXPERIMENT_TAG not in said  # one run's columns would be all runs'
    start = metadata.parse_session_start_info_plugin_data(said[metadata.SESSION_START_INFO_TAG])
    assert start.hparams["model.name"].string_value == "tiny" and start.hparams["data.batch_size"].number_value == 4
    end = metadata.parse_session_end_info_plugin_data(said[metadata.SESSION_END_INFO_TAG])
    assert end.status == api_pb2.STATUS_SUCCESS
    assert start.hparams["kind"].string_value == "training"
    assert events.Scalars("held-out/psnr")[-1].value == pytest.approx(metrics["val/psnr"])
    tags = events.Tags()
    (layout,) = events.Tensors("custom_scalars__config__")
    charts = layout_pb2.Layout.FromString(layout.tensor_proto.string_val[0]).category[0].chart
    shown = {tag for chart in charts for tag in chart.multiline.tag}
    assert "held-out/psnr" in shown and shown <= set(tags["scalars"])
    assert tags["images"] == ["held-out/input, render, depth, cdm, truth"]
    groups = [tag.partition("/")[0] for tag in sorted([*tags["scalars"], *tags["images"]])]
    assert list(dict.fromkeys(groups)) == ["held-out", "train"]  # as TensorBoard sorts them
    config = events.Tensors("config/text_summary")[0].tensor_proto.string_val[0].decode()
    assert "batch_size: 4" in config


def test_a_run_that_failed_says_so_in_tensorboard(data, tmp_path, monkeypatch):
    class Fail(Callback):
        def on_train_batch_end(self, *args):
            raise ValueError("broken")

    with pytest.raises(ValueError, match="broken"):
        train_with(monkeypatch, Fail(), data, tmp_path)
    said = EventAccumulator(str(tmp_path / "tensorboard")).Reload().PluginTagToContent(metadata.PLUGIN_NAME)
    end = metadata.parse_session_end_info_plugin_data(said[metadata.SESSION_END_INFO_TAG])
    assert end.status == api_pb2.STATUS_FAILURE


def test_training_lowers_the_loss(data, tmp_path):
    short = run_training(data, tmp_path / "a", "trainer.max_steps=3", "optimizer.lr=0.003")
    longer = run_training(data, tmp_path / "b", "trainer.max_steps=40", "validation_every=40", "optimizer.lr=0.003")
    assert longer["val/psnr"] > short["val/psnr"] + 2
    assert longer["val/loss_dm"] < 0.9 * short["val/loss_dm"]


def test_kill_9_then_the_same_command_ends_as_if_nothing_happened(data, tmp_path):
    steps = ["trainer.max_steps=30", "validation_every=1000", "callbacks.last.every_n_steps=1"]
    last = tmp_path / "killed" / "checkpoints" / "last.ckpt"
    process = subprocess.Popen(command(data, tmp_path / "killed", *steps), env=environment())
    deadline = time.monotonic() + 120
    while not last.is_file() and time.monotonic() < deadline:
        time.sleep(0.02)
    process.kill()
    process.wait()
    assert 0 < last_checkpoint(tmp_path / "killed")["global_step"] < 30
    run_command(data, tmp_path / "killed", *steps)
    run_training(data, tmp_path / "whole", *steps)
    assert_same_state(last_checkpoint(tmp_path / "whole"), last_checkpoint(tmp_path / "killed"))


def test_a_finished_run_can_be_prolonged(data, tmp_path):
    constant = ("optimizer.decay=none",)
    run_training(data, tmp_path / "grown", "trainer.max_steps=3", *constant)
    run_training(data, tmp_path / "grown", "trainer.max_steps=6", *constant)
    run_training(data, tmp_path / "whole", "trainer.max_steps=6", *constant)
    assert_same_state(last_checkpoint(tmp_path / "whole"), last_checkpoint(tmp_path / "grown"))


def differing(one, two) -> float:
    """Share of numbers that differ by more than rounding: Adam makes a step of any gradient that is next to nothing,
    of whichever sign it was rounded to."""
    assert one.keys() == two.keys()
    far = [~torch.isclose(two[name].double(), value.double(), atol=2e-4, rtol=1e-3) for name, value in one.items()]
    return torch.cat([numbers.flatten() for numbers in far]).double().mean().item()


def test_other_draws_train_something_else(data, tmp_path, whole):
    """What the tests below would see if batches were not the same."""
    run_training(data, tmp_path, "data.seed=1")
    one, two = last_checkpoint(whole[0])["current_model_state"], last_checkpoint(tmp_path)["current_model_state"]
    assert differing(one, two) > 0.1


def test_accumulated_batches_give_the_gradients_of_one(data, tmp_path, whole):
    run_training(data, tmp_path, "trainer.accumulate_grad_batches=2")
    one, two = last_checkpoint(whole[0])["current_model_state"], last_checkpoint(tmp_path)["current_model_state"]
    assert differing(one, two) < 1e-3


def test_two_processes_train_what_one_does_also_when_they_are_stopped(data, tmp_path, whole):
    """The scheduler's signal reaches the first of them, which has them all stop after the same step."""
    more = ["trainer=ddp", "trainer.accelerator=cpu", "trainer.devices=2", "trainer.precision=32-true"]
    progress = "{_target_: nerfdiff.training.callbacks.progress.TrainingProgress, every_steps: 1, every_seconds: 60}"
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True, "env": environment()}
    process = subprocess.Popen(command(data, tmp_path, *more, f"callbacks.progress={progress}"), **pipes)
    for line in process.stdout:
        if "step 1 of 6, loss" in line:
            process.send_signal(signal.SIGTERM)
            break
    _, said = process.communicate(timeout=300)
    step = last_checkpoint(tmp_path)["global_step"]
    assert process.returncode == 143 and 0 < step < 6, said
    assert said.count("stopped by SIGTERM") == said.count(f"stopped by SIGTERM. Step {step} is saved in ") == 1
    assert "Traceback" not in said
    run_command(data, tmp_path, *more)
    one, two = last_checkpoint(whole[0]), last_checkpoint(tmp_path)
    assert two["global_step"] == one["global_step"]
    assert differing(one["current_model_state"], two["current_model_state"]) < 1e-3


def test_exported_and_checkpointed_averages_agree(whole):
    run, _ = whole
    from_run = load_model(run, "ema", run).model.state_dict()
    exported = load_model(run / "model", "ema", run).model.state_dict()
    raw = load_model(run, "raw", run).model.state_dict()
    assert all(torch.equal(from_run[name], exported[name]) for name in from_run)
    assert any(not torch.equal(from_run[name], raw[name]) for name in from_run)


def test_the_same_command_on_a_finished_run_exports_the_same_average(data, tmp_path):
    run_training(data, tmp_path)
    first = load_model(tmp_path / "model", "ema", tmp_path)
    run_training(data, tmp_path)
    again = load_model(tmp_path / "model", "ema", tmp_path)
    assert first.image_size == again.image_size == [10, 14]
    for name, value in first.model.state_dict().items():
        assert torch.equal(value, again.model.state_dict()[name])


def test_a_resumed_run_follows_the_optimizer_settings_it_is_given(data, tmp_path):
    constant = ("optimizer.decay=none", "optimizer.warmup_steps=0")
    run_training(data, tmp_path, "trainer.max_steps=2", *constant, "optimizer.lr=0.001")
    metrics = run_training(data, tmp_path, "trainer.max_steps=4", *constant, "optimizer.lr=0.0002")
    assert metrics["lr-AdamW"] == pytest.approx(0.0002)


def test_memory_settings_may_change_on_resuming_but_accumulation_may_not(data, tmp_path):
    run_training(data, tmp_path, "trainer.max_steps=2")
    with pytest.raises(CheckpointError, match="accumulate_grad_batches: 1 → 2"):
        run_training(data, tmp_path, "trainer.accumulate_grad_batches=2")
    run_training(
        data,
        tmp_path,
        "trainer.max_steps=4",
        "model.render.chunk=1024",
        "model.unet.checkpointing=true",
        "model.render.least_transmittance=0",
    )
    assert last_checkpoint(tmp_path)["global_step"] == 4


def test_without_logger_and_average(data, tmp_path):
    run_training(data, tmp_path, "trainer.max_steps=2", "~logger", "callbacks.ema=null")
    assert load_model(tmp_path / "model", "raw", tmp_path).weights == "raw"
    with pytest.raises(CheckpointError, match="use weights=raw"):
        load_model(tmp_path / "model", "ema", tmp_path)


def test_resuming_with_another_model_is_refused_by_name(data, whole):
    with pytest.raises(CheckpointError, match=re.escape("model.field.channels: 4 → 6")):
        run_training(data, whole[0], "model.field.channels=6")


def test_a_folder_with_a_checkpoint_is_not_overwritten(data, whole):
    with pytest.raises(CheckpointError, match="resume=false"):
        run_training(data, whole[0], "resume=false")


def test_a_damaged_checkpoint_is_named(data, tmp_path):
    (tmp_path / "checkpoints").mkdir()
    (tmp_path / "checkpoints" / "last.ckpt").write_bytes(b"PK\x03\x04 torn")
    with pytest.raises(CheckpointError, match=r"last\.ckpt is not a readable checkpoint"):
        run_training(data, tmp_path)


def test_a_full_disk_costs_no_earlier_checkpoint(data, tmp_path):
    run_training(data, tmp_path, "trainer.max_steps=2")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, hard))  # what the file system answers when it is full
    try:
        with pytest.raises(CheckpointError, match=r"cannot write .*last\.ckpt"):
            run_training(data, tmp_path, "trainer.max_steps=4", "validation_every=1000")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert last_checkpoint(tmp_path)["global_step"] == 2
    run_training(data, tmp_path, "trainer.max_steps=4")
    assert last_checkpoint(tmp_path)["global_step"] == 4


def test_training_goes_on_without_a_validation_split(data, tmp_path):
    root = tmp_path / "data"
    root.mkdir()
    (root / "cars_train").symlink_to(data / "cars_train")
    metrics = run_training(root, tmp_path / "run")
    assert "val/psnr" not in metrics and last_checkpoint(tmp_path / "run")["global_step"] == 6


def test_an_unknown_kernel_precision_is_named(data, tmp_path):
    with pytest.raises(ConfigError, match="kernel_precision='fp8': choose auto, ieee"):
        run_training(data, tmp_path / "run", "kernel_precision=fp8")


def test_a_missing_root_is_named(tmp_path):
    with pytest.raises(DataError, match="nowhere"):
        run_training(tmp_path / "nowhere", tmp_path / "run")


def test_the_command_prints_one_line_for_an_error(tmp_path):
    done = subprocess.run(
        command(tmp_path / "nowhere", tmp_path / "run"), capture_output=True, text=True, env=environment()
    )
    assert done.returncode == 1
    assert "Traceback" not in done.stderr
    assert done.stderr.strip().splitlines()[-1].startswith("error: ")
