import pytest
import torch

from nerfdiff.cli import load_config
from nerfdiff.diffusion import layout
from nerfdiff.diffusion.layout import channels_last
from nerfdiff.evaluation.run import dataset_run
from nerfdiff.utils.errors import ConfigError
from training_fixtures import evaluation_overrides, last_checkpoint, run_training, write_dataset

CPU, GPU, OTHER = torch.device("cpu"), torch.device("cuda", 0), torch.device("mps")


@pytest.mark.parametrize(
    ("device", "compiled", "kernels", "expected"),
    [
        (CPU, False, False, True),
        (CPU, True, False, True),
        (GPU, True, False, True),
        (GPU, True, True, True),
        (GPU, False, True, True),
        (GPU, False, False, False),
        (OTHER, False, False, False),
    ],
)
def test_the_layout_follows_from_where_and_how_unets_run(device, compiled, kernels, expected, monkeypatch):
    monkeypatch.setattr(layout, "kernels_run", lambda asked: kernels and asked == device)
    assert channels_last(None, device, compiled) == expected
    assert channels_last(True, device, compiled) and not channels_last(False, device, compiled)


@pytest.mark.parametrize("choice", [1, "auto"])
def test_another_choice_is_refused(choice):
    with pytest.raises(ConfigError, match="channels_last takes true, false or null, got"):
        channels_last(choice, CPU, False)


def test_a_run_in_one_layout_goes_on_in_another_and_is_evaluated_in_either(tmp_path):
    data, run = write_dataset(tmp_path / "data", scenes=2), tmp_path / "run"
    for step, (choice, chosen) in enumerate([("false", False), ("null", True)]):
        layout_of_unets = f"channels_last={choice}"
        run_training(data, run, f"trainer.max_steps={step + 1}", layout_of_unets, "callbacks.previews=null")
        checkpoint = last_checkpoint(run)
        assert checkpoint["global_step"] == step + 1
        assert checkpoint["hyper_parameters"]["channels_last"] == chosen
        given = evaluation_overrides(data, run, tmp_path / "out", "data.image_size=[10,14]", layout_of_unets)
        evaluated = dataset_run(load_config("evaluate", given), CPU).model
        weight = evaluated.denoiser.unet.conv_in.weight
        assert weight.is_contiguous(memory_format=torch.channels_last) == chosen
