"""Damaged, exchanged and malicious files of models: refused in a sentence that says what to do, and never used."""

import json
import pickle
import shutil
import sqlite3
import zipfile

import numpy as np
import pytest
import torch
import yaml

from fault_fixtures import *  # noqa: F403
from fault_fixtures import change, flip, flip_weights, go_on
from nerfdiff.checkpoint import export, last_checkpoint, load_model, read_checkpoint
from nerfdiff.data.cache import CachedReader
from nerfdiff.data.readers.srn import SRNReader
from nerfdiff.inputs import ASSETS
from nerfdiff.training.kept_renderings import KeptRenderings
from nerfdiff.utils.errors import CheckpointError, DataError, size_text


def test_flipped_weights_are_noticed_and_the_checkpoint_before_is_taken(fault_data, damaged_run, caplog):
    last = damaged_run / "checkpoints" / "last.ckpt"
    flip_weights(last, 200, seed=0)
    with pytest.raises(CheckpointError, match=r"last\.ckpt is not a readable checkpoint \(bytes of .* changed since"):
        read_checkpoint(last)
    assert load_model(damaged_run, "ema").path.name == "previous.ckpt"
    go_on(fault_data, damaged_run)
    assert caplog.text.count("last.ckpt is not a readable checkpoint") >= 1
    assert read_checkpoint(last)["global_step"] == 3


def test_a_checkpoint_that_was_checked_is_checked_again_when_it_changed(damaged_run):
    last = damaged_run / "checkpoints" / "last.ckpt"
    read_checkpoint(last)
    flip_weights(last, 1, seed=0)
    with pytest.raises(CheckpointError, match="changed since they were written"):
        read_checkpoint(last)


@pytest.mark.parametrize("share", [0.0, 0.3, 0.999])
def test_a_truncated_checkpoint_names_the_one_beside_it(share, damaged_run):
    folder = damaged_run / "checkpoints"
    (folder / "previous.ckpt").unlink()
    content = (folder / "last.ckpt").read_bytes()
    (folder / "last.ckpt").write_bytes(content[: int(share * len(content))])
    step = torch.load(folder / "best.ckpt", weights_only=True)["global_step"]
    words = rf"last\.ckpt is not a readable checkpoint .*{folder / 'best.ckpt'} beside it can be read, of step {step}"
    for read in (lambda: load_model(damaged_run, "ema"), lambda: last_checkpoint(damaged_run)):
        with pytest.raises(CheckpointError, match=words):
            read()


def test_the_advice_works(fault_data, damaged_run):
    folder = damaged_run / "checkpoints"
    (folder / "previous.ckpt").unlink()
    (folder / "last.ckpt").write_bytes(b"PK")
    with pytest.raises(CheckpointError, match=f"copy it to {folder / 'last.ckpt'}"):
        go_on(fault_data, damaged_run)
    shutil.copy(folder / "best.ckpt", folder / "last.ckpt")
    go_on(fault_data, damaged_run)
    assert read_checkpoint(folder / "last.ckpt")["global_step"] == 3


def test_where_nothing_can_be_read_that_is_said(damaged_run):
    for path in (damaged_run / "checkpoints").iterdir():
        path.write_bytes(b"")
    with pytest.raises(CheckpointError, match="Give another checkpoint, or delete it to start afresh"):
        last_checkpoint(damaged_run)


class Malicious:
    def __reduce__(self):
        return exec, ("raise SystemExit('it ran')",)


@pytest.mark.parametrize("how", ["pickle", "checkpoint", "module"])
def test_a_pickle_that_runs_something_is_refused_without_advice_to_run_it(how, damaged_run):
    path = damaged_run / "checkpoints" / "best.ckpt"
    if how == "pickle":
        path.write_bytes(pickle.dumps(Malicious()))
        words = "is not a readable checkpoint"
    else:
        torch.save({"state_dict": Malicious() if how == "checkpoint" else torch.nn.Linear(1, 1)}, path)
        words = r"holds \S+, which could run anything, and was not loaded\. .*last\.ckpt beside it"
    with pytest.raises(CheckpointError, match=words) as error:
        load_model(path, "ema")
    assert "weights_only" not in str(error.value) and "\n" not in str(error.value)


def test_a_checkpoint_that_was_packed_anew_is_refused(damaged_run):
    """Compressed, whose bytes PyTorch would take for weights as they are."""
    path = damaged_run / "checkpoints" / "best.ckpt"
    packed = path.with_name("packed.ckpt")
    with zipfile.ZipFile(path) as old, zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as new:
        for entry in old.namelist():
            new.writestr(entry, old.read(entry))
    with pytest.raises(CheckpointError, match="compressed"):
        load_model(packed, "ema")


@pytest.mark.parametrize(
    ("entries", "words"),
    [
        ({"hyper_parameters": "model"}, "it holds no model settings"),
        ({"hyper_parameters": None}, "it holds no model settings"),
        ({"hyper_parameters": {"model": "large"}}, "it holds no model settings"),
        ({"hyper_parameters": {"model": {"unet": "x", "field": {}}}}, "it holds no model settings"),
        ({"state_dict": "weights"}, "expected tensors by name as its state_dict, found a str"),
        ({"state_dict": {"model.x": 1.0}}, "expected tensors by name"),
        ({"current_model_state": [1]}, "expected tensors by name as its current_model_state"),
        ({"global_step": "2"}, "expected a number of steps"),
        ({"image_size": "large"}, r"expected \[height, width\]"),
        ({"image_size": [20]}, r"expected \[height, width\]"),
        ({"stability": 3}, "expected numbers by name"),
        ({"SceneDataModule": {"root": 1}}, "expected what it was trained on"),
    ],
)
def test_entries_of_another_kind_are_refused(entries, words, damaged_run):
    path = damaged_run / "checkpoints" / "last.ckpt"
    change(path, **entries)
    with pytest.raises(CheckpointError, match=rf"last\.ckpt is not a checkpoint of NerfDiffModule: {words}"):
        load_model(path, "ema")
    assert last_checkpoint(damaged_run).name == "previous.ckpt"


@pytest.mark.parametrize(
    "settings",
    [
        {"unet": {"width": "wide"}},
        {"unet": {"width": -32}},
        {"unet": {"width": 10**9}},
        {"unet": {"channel_mult": 3}},
        {"field": {"channels": None}},
        {"render": {"uniform_samples": "many"}},
        {"render": "fine"},
        {"conditioning": "rendered"},
        {"name": 3, "more": True},
    ],
)
def test_settings_that_are_none_are_refused(settings, damaged_run):
    """The widest would take more memory than there is."""
    path = damaged_run / "checkpoints" / "last.ckpt"
    hyper = torch.load(path, weights_only=True)["hyper_parameters"]
    for key, value in settings.items():
        hyper["model"][key] = hyper["model"][key] | value if isinstance(value, dict) else value
    change(path, hyper_parameters=hyper)
    with pytest.raises(CheckpointError, match=r"last\.ckpt (does not fit its own settings|is not a checkpoint)"):
        load_model(path, "ema")


def with_one(path, value: float) -> dict:
    """A checkpoint's averaged weights, of which one is another."""
    state = torch.load(path, weights_only=True)["state_dict"]
    name = next(name for name in state if name.endswith(".bias"))
    return state | {name: state[name].clone().index_fill_(0, torch.tensor([3]), value)}


@pytest.mark.parametrize("value", [float("nan"), float("inf"), 1e6])
def test_what_is_not_finite_is_not_exported(value, damaged_run, tmp_path):
    """Also where only the smaller type cannot hold it."""
    path = damaged_run / "checkpoints" / "last.ckpt"
    change(path, state_dict=with_one(path, value))
    words = "only holds 6.55e.04" if value == 1e6 else "not finite .*is not exported"
    with pytest.raises(CheckpointError, match=words):
        export(str(path), "ema", tmp_path / "out", "float16", None)
    assert not (tmp_path / "out").exists()


def test_a_run_that_ends_with_weights_that_are_not_finite_fails(fault_data, damaged_run):
    """It exported them, and ended with status 0."""
    path = damaged_run / "checkpoints" / "last.ckpt"
    change(path, state_dict=with_one(path, float("nan")))
    before = (damaged_run / "model" / "model.safetensors").read_bytes()
    with pytest.raises(CheckpointError, match="not exported"):
        go_on(fault_data, damaged_run, "trainer.max_steps=2")
    assert (damaged_run / "model" / "model.safetensors").read_bytes() == before


@pytest.fixture
def exported(fault_run, tmp_path):
    return shutil.copytree(fault_run / "model", tmp_path / "model")


def test_exported_weights_are_checked(exported):
    weights = exported / "model.safetensors"
    load_model(exported, "ema")
    size = weights.stat().st_size
    flip(weights, 1, seed=1, start=size // 2, end=size)
    with pytest.raises(CheckpointError, match=r"model\.safetensors and .*model\.yaml are not as they were written"):
        load_model(exported, "ema")


def test_exported_settings_are_checked(exported):
    """Also where the model can be built with the others."""
    text = (exported / "model.yaml").read_text()
    assert text.count("density_shift: -3.0") == 1
    (exported / "model.yaml").write_text(text.replace("density_shift: -3.0", "density_shift: -1.0"))
    with pytest.raises(CheckpointError, match="damaged, edited or exchanged"):
        load_model(exported, "ema")


def test_exports_without_a_digest_are_read(exported):
    """As those of earlier versions."""
    settings = yaml.safe_load((exported / "model.yaml").read_text())
    assert len(settings.pop("sha256")) == 64
    (exported / "model.yaml").write_text(yaml.safe_dump(settings))
    load_model(exported, "ema")
    assert len(yaml.safe_load((ASSETS / "demo" / "model.yaml").read_text())["sha256"]) == 64


@pytest.mark.parametrize(
    "text",
    [
        "",
        "x",
        "- 1",
        "weights: ema",
        "!!python/object/apply:os.system [x]",
        "model: &a [*a]",
        "{weights: ema, image_size: 3, model: {}}",
        "{weights: ema, image_size: null, model: x}",
        "{weights: ema, image_size: null, model: {name: x}}",
        "\x00",
        "a: \xff",
    ],
)
def test_settings_beside_weights_that_are_none_are_refused(text, exported):
    (exported / "model.yaml").write_text(text, encoding="latin-1")
    with pytest.raises(CheckpointError, match=r"model\.(yaml cannot be read|safetensors does not fit its own)"):
        load_model(exported, "ema")


@pytest.fixture
def cache(fault_data, tmp_path):
    def make() -> CachedReader:
        reader = SRNReader(fault_data, "cars", "train", 0.8, 1.8, None)
        return CachedReader(reader, tmp_path / "cache", "toy_train")

    make().load(0)
    return make


def test_inverted_pixels_in_the_cache_are_refused(cache):
    path = cache().path / "images.u8"
    pixels = np.fromfile(path, np.uint8)
    image = pixels.size // 15  # three scenes of five views
    pixels[image + 100] ^= 255
    pixels.tofile(path)
    copy = cache()
    copy.load(0, [0, 2, 3, 4])
    with pytest.raises(DataError, match=r"toy_train-.*damaged; delete this folder"):
        copy.load(0, [1])


def read_all(cache) -> None:
    copy = cache()
    for scene in range(len(copy)):
        copy.load(scene)


@pytest.mark.parametrize("name", ["scenes.json", "cameras.npz", "images.u8"])
@pytest.mark.parametrize("how", ["flipped", "empty", "missing", "a folder", "another's"])
def test_damaged_cache_metadata_are_refused(name, how, cache):
    path = cache().path / name
    content = path.read_bytes()
    path.unlink()
    if how == "flipped":
        for seed in range(20):
            path.write_bytes(content)
            flip(path, 1, seed)
            with pytest.raises(DataError, match="damaged; delete this folder"):
                read_all(cache)
        return
    if how == "a folder":
        path.mkdir()
    elif how != "missing":
        path.write_bytes(b"" if how == "empty" else json.dumps({"ids": [1], "views": 3}).encode())
    with pytest.raises(DataError, match="damaged; delete this folder"):
        cache()


def test_kept_renderings_are_checked(tmp_path):
    kept = KeptRenderings(tmp_path)
    kept.get(["a"], (2, 2), lambda missing: torch.rand(1, 3, 2, 2))
    with sqlite3.connect(kept.path) as file:
        file.execute("UPDATE checked SET pixels = zeroblob(12)")
    with pytest.raises(CheckpointError, match=r"bytes of a changed since they were written.*delete this folder"):
        kept.get(["a"], (2, 2), pytest.fail)


@pytest.mark.parametrize(
    ("count", "text"),
    [(0, "0 bytes"), (999, "999 bytes"), (147_456, "147 kB"), (3.4e6, "3.4 MB"), (57e9, "57 GB"), (5e15, "5000 TB")],
)
def test_amounts_are_readable_whatever_their_size(count, text):
    assert size_text(count) == text
