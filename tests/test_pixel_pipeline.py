"""A pixel-aligned NeRF from the command's settings to a row of results."""

import pytest
import torch

from nerfdiff.checkpoint import check_resumable, load_model
from nerfdiff.cli import load_config
from nerfdiff.evaluation.distill import distill
from nerfdiff.evaluation.evaluate import evaluate
from nerfdiff.model import settings_of
from nerfdiff.results.row import read_rows
from nerfdiff.training.run import train
from nerfdiff.utils.errors import CheckpointError, ConfigError
from training_fixtures import evaluation_overrides, last_checkpoint, overrides, write_dataset

SMALL = {
    "pixelnerf": ["model.field.encoder.channels=[8,8,16]", "model.field.encoder.blocks=[1,1]"],
    "visionnerf": ["model.field.encoder.transformer.width=16", "model.field.encoder.transformer.mlp=16"],
}


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return write_dataset(tmp_path_factory.mktemp("data"), scenes=2)


def settings(data, run, name):
    words = [word for word in overrides(data, run) if not word.startswith("model.field")]
    words += [f"field={name}", *SMALL[name], "model.field.mlp.hidden=16", "trainer.max_steps=2", "validation_every=2"]
    return load_config("train", [*words, "data.image_size=[20,28]", f"paths.output_dir={run}"])


@pytest.mark.parametrize("name", SMALL)
def test_it_trains_resumes_is_evaluated_and_makes_a_row(data, tmp_path, name):
    run, out = tmp_path / "run", tmp_path / "out"
    cfg = settings(data, run, name)
    assert train(cfg)["val/psnr"] > 0
    train(cfg)  # complete: nothing is left to do
    assert last_checkpoint(run)["global_step"] == 2
    averaged, exported = load_model(run, "ema", tmp_path), load_model(run / "model", "ema", tmp_path)
    assert averaged.model.field_name == exported.model.field_name == name
    for key, value in averaged.model.state_dict().items():
        assert torch.equal(value, exported.model.state_dict()[key]), key

    more = ["orbit.frames=2", "baselines=false"]
    rows = evaluate(load_config("evaluate", evaluation_overrides(data, run, out, *more)))
    assert rows[0].status == "ok" and 0 < rows[0].psnr < 60 and rows[0].field == name
    assert rows[0].field_queries == 2 * 4 * 20 * 28 * 8 and rows[0].depth_rmse is not None
    (folder,) = out.glob("none-*")
    assert (folder / "sheet.png").is_file() and (folder / "orbit.mp4").is_file()  # though no field was kept


def test_distilling_it_ends_with_one_line_and_a_row(data, tmp_path):
    run, out = tmp_path / "run", tmp_path / "out"
    train(settings(data, run, "pixelnerf"))
    words = evaluation_overrides(data, run, out, "budget=minutes", "budget.views=2", "orbit.frames=0", "sheet.scenes=0")
    with pytest.raises(ConfigError, match="which has no triplane to fit"):
        distill(load_config("distill", words))
    (row,) = read_rows(out / "results.jsonl")
    assert row.status == "error" and "no triplane to fit" in row.error
    words += ["strategy=none"]
    distill(load_config("distill", words))
    assert [row.status for row in read_rows(out / "results.jsonl")] == ["error", "ok"]


def test_a_run_of_another_field_is_not_gone_on_with(data, tmp_path):
    words = ["model=tiny", "data=srn_cars", "trainer=cpu"]
    other, same = (load_config("train", [*words, f"field={name}"]) for name in ("pixelnerf", "triplane"))
    model = settings_of(same)
    del model["field"]["name"]  # as of a run from before fields had names
    torch.save({"hyper_parameters": {"model": model}, "state_dict": {}, "global_step": 0}, tmp_path / "last.ckpt")
    check_resumable(tmp_path / "last.ckpt", settings_of(same), 1)
    with pytest.raises(CheckpointError, match=r"model\.field\.name: triplane → pixelnerf"):
        check_resumable(tmp_path / "last.ckpt", settings_of(other), 1)
