"""A field that is saved and loaded renders the same, and nothing else is taken for one."""

import pytest
import torch
from safetensors.torch import save_file

from fault_fixtures import flip
from model_fixtures import input_cameras, look_at, model
from nerfdiff.cameras import Cameras
from nerfdiff.fit.refined_field import RefinedField
from nerfdiff.fit.saved_field import FIELD, SavedField, load_field, save_field
from nerfdiff.utils.errors import DataError
from nerfdiff.utils.files import write_text


@pytest.fixture(scope="module")
def saved() -> SavedField:
    net = model().requires_grad_(False)
    source = input_cameras(1, 16, 24)
    encoding = net.encode_images(torch.rand(1, 3, 16, 24), source, torch.tensor([0.8]), torch.tensor([1.8]))
    return SavedField(RefinedField(encoding.triplane, net.decoder), net.renderer)


def test_it_renders_the_same_without_the_checkpoint(saved, tmp_path):
    save_field(tmp_path / FIELD, saved)
    loaded = load_field(tmp_path / FIELD)
    cameras = Cameras(look_at((0.5, 0.2, 0.4))[None, None], saved.field.K[:, None], 12, 20)
    before, after = (s.field.render(s.renderer, cameras) for s in (saved, loaded))
    assert torch.equal(before.images, after.images) and torch.equal(before.depth, after.depth)
    assert loaded.renderer == saved.renderer
    assert (loaded.field.cameras.height, loaded.field.cameras.width) == (16, 24)


def test_fitting_the_copy_leaves_the_model_alone(saved):
    net = model()
    field = RefinedField(saved.field.field().triplane, net.decoder)
    with torch.no_grad():
        for parameter in field.parameters():
            parameter += 1
    assert not torch.equal(net.decoder.hidden.weight, field.decoder.hidden.weight)
    assert not torch.equal(saved.field.planes, field.planes)


@pytest.mark.parametrize("content", ["text", "other tensors", "missing"])
def test_what_is_no_field_is_named(content, tmp_path):
    path = tmp_path / FIELD
    if content == "text":
        write_text(path, "no tensors")
    elif content == "other tensors":
        save_file({"weight": torch.zeros(2)}, path)
    with pytest.raises(DataError, match=r"field\.safetensors: not a field saved by this project"):
        load_field(path)


def test_bytes_that_changed_are_noticed(saved, tmp_path):
    path = tmp_path / FIELD
    save_field(path, saved)
    flip(path, 1, seed=5, start=path.stat().st_size // 2)
    with pytest.raises(DataError, match="its bytes changed since it was written"):
        load_field(path)
