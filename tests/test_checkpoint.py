"""Models are loaded with the renderer that a run asks for; what is saved stays as it was trained."""

import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from model_fixtures import config
from nerfdiff.checkpoint import check_same_data, load_model
from nerfdiff.exported_model import LoadedModel, export_model
from nerfdiff.model import NerfDiff
from nerfdiff.utils.errors import CheckpointError, ConfigError

SETTINGS = (
    {},
    {"backend": "torch", "kernel_precision": "tf32", "skip": "faint"},
    {"uniform_samples": 3, "chunk": 2048},
)


@pytest.mark.parametrize("settings", SETTINGS)
def test_a_model_is_built_with_the_renderer_settings_of_the_run(settings):
    plain, loaded = load_model("demo", "ema"), load_model("demo", "ema", renderer=settings)
    assert vars(loaded.model.renderer) == vars(plain.model.renderer) | settings
    assert loaded.config == plain.config
    assert not {"backend", "kernel_precision"} & loaded.config["render"].keys()


@pytest.mark.parametrize("settings", [{"backend": "cuda"}, {"kernel_precision": "fp8"}])
def test_settings_that_a_renderer_cannot_have_are_no_fault_of_the_checkpoint(settings):
    ((name, value),) = settings.items()
    with pytest.raises(ConfigError, match=f"{name}='{value}': choose auto"):
        load_model("demo", "ema", renderer=settings)


@pytest.fixture
def pair(tmp_path):
    """Two exports of models that differ in their CDM alone; the second shares the first's other weights."""
    made = [LoadedModel(NerfDiff(**config()).eval(), Path("made"), "ema", config(), [12, 12], {}) for _ in range(2)]
    made[1].model.encoder.load_state_dict(made[0].model.encoder.state_dict())
    made[1].model.decoder.load_state_dict(made[0].model.decoder.state_dict())
    one = export_model(made[0], tmp_path / "one", torch.float16)
    return made, one, export_model(made[1], tmp_path / "two", torch.float16, tmp_path / "one")


def test_equal_weights_are_shared_and_the_model_is_the_same(pair, tmp_path):
    made, one, two = pair
    assert two.stat().st_size < 0.6 * one.stat().st_size
    alone = export_model(made[1], tmp_path / "alone", torch.float16)
    first, second = (load_model(path.parent, "ema").model.state_dict() for path in (two, alone))
    assert first.keys() == second.keys() and all(torch.equal(first[name], second[name]) for name in first)


def test_a_shared_model_that_is_gone_or_another_is_refused(pair, tmp_path):
    made, one, two = pair
    export_model(replace(made[1]), tmp_path / "one", torch.float16)
    with pytest.raises(CheckpointError, match="with which it was exported, and these are others"):
        load_model(two.parent, "ema")
    shutil.rmtree(one.parent)
    with pytest.raises(CheckpointError, match="are not there: copy both folders together"):
        load_model(two.parent, "ema")


def test_only_a_neighbour_that_has_equal_weights_is_shared(pair, tmp_path):
    made, one, _ = pair
    with pytest.raises(ConfigError, match="only a model in the folder that"):
        export_model(made[1], tmp_path / "deep" / "two", torch.float16, one.parent)
    other = NerfDiff(**config())
    with torch.no_grad():
        for value in [*other.parameters(), *other.buffers()]:
            value.add_(1)
    with pytest.raises(ConfigError, match="has none of the weights"):
        export_model(replace(made[0], model=other), tmp_path / "two", torch.float16, one.parent)


def test_data_that_is_streamed_is_that_of_the_reader_it_was_made_from(monkeypatch):
    """Shards keep the reader's name and digest, and need no data.root."""
    began = {"root": "/a", "reader": "srn /a/cars_train", "files": "1"}
    monkeypatch.setattr("nerfdiff.checkpoint.read_checkpoint", lambda path: {"SceneDataModule": began})
    check_same_data(Path("last.ckpt"), began | {"root": "/elsewhere"})
    check_same_data(Path("last.ckpt"), {"root": "/b", "reader": "srn /b/cars_train", "files": "1"})  # moved
    for other in ({"files": "2"}, {"root": "/b", "reader": "srn /c/cars_train"}):
        with pytest.raises(CheckpointError, match="was trained on"):
            check_same_data(Path("last.ckpt"), began | other)
