"""A field that is saved and loaded renders the same, and nothing else is taken for one."""

import json
import math
from dataclasses import replace

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file

from fault_fixtures import flip
from model_fixtures import input_cameras, look_at, model
from nerfdiff.cameras import Cameras
from nerfdiff.fit import compact_planes
from nerfdiff.fit.compact_planes import compact, restored
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
    torch.testing.assert_close(after.images, before.images, rtol=0, atol=1 / 255)
    torch.testing.assert_close(after.depth, before.depth, rtol=0, atol=5e-3)
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
    said = "no such file; name a" if content == "missing" else "not a field saved by this project"
    with pytest.raises(DataError, match=rf"field\.safetensors: {said}"):
        load_field(path)


def test_bytes_that_changed_are_noticed(saved, tmp_path):
    path = tmp_path / FIELD
    save_field(path, saved)
    flip(path, 1, seed=5, start=path.stat().st_size // 2)
    with pytest.raises(DataError, match="its bytes changed since it was written"):
        load_field(path)


def test_a_field_of_before_is_read_as_it_is(saved, tmp_path):
    save_field(tmp_path / FIELD, saved)
    with safe_open(tmp_path / FIELD, framework="pt") as file:
        header = json.loads(file.metadata()["nerfdiff"])
    header = {name: value for name, value in header.items() if name not in ("planes", "sha256")} | {"format": 1}
    state = {name: value.detach().contiguous() for name, value in saved.field.state_dict().items()}
    save_file(state, tmp_path / "old.safetensors", {"nerfdiff": json.dumps(header)})
    loaded = load_field(tmp_path / "old.safetensors").field.state_dict()
    assert loaded.keys() == state.keys() and all(torch.equal(loaded[name], state[name]) for name in state)
    save_file(state, tmp_path / "new.safetensors", {"nerfdiff": json.dumps(header | {"format": 3})})
    with pytest.raises(DataError, match="format 3, expected at most 2"):
        load_field(tmp_path / "new.safetensors")


def scattered(density: float, size: int = 24) -> SavedField:
    """A field whose outputs are as steep as `density` says: rough planes, thin floaters in them."""
    net = model().requires_grad_(False)
    source, bounds = input_cameras(1, size, size), (torch.tensor([0.8]), torch.tensor([1.8]))
    encoding = net.encode_images(
        torch.rand(1, 3, size, size, generator=torch.Generator().manual_seed(4)), source, *bounds
    )
    field = RefinedField(encoding.triplane, net.decoder)
    with torch.no_grad():
        field.planes.normal_(generator=torch.Generator().manual_seed(5)).mul_(density)
        field.planes[0, :, :, 3, 5] *= 8
    return SavedField(field, replace(net.renderer, background=1.0))


@pytest.mark.parametrize("density", [0.0, 1.0, 4.0])
def test_no_colour_of_views_that_were_not_checked_moves_by_more_than_one_of_255(density, tmp_path):
    kept = scattered(density)
    save_field(tmp_path / FIELD, kept)
    loaded = load_field(tmp_path / FIELD)
    places = torch.stack([look_at(place) for place in [(0.9, -0.4, 0.7), (-0.8, 0.3, 1.0), (0.1, 1.1, 1.2)]])
    cameras = Cameras(places[None], kept.field.K[:, None].expand(1, 3, 3, 3), 40, 40)
    before, after = (s.field.render(s.renderer, cameras).images for s in (kept, loaded))
    assert (before - after).abs().max() < 1 / 255
    full = 4 * sum(value.numel() for value in kept.field.state_dict().values())
    assert (tmp_path / FIELD).stat().st_size < 0.7 * full


def test_planes_stay_as_they_are_where_no_form_of_them_is_good_enough(monkeypatch, tmp_path):
    kept = scattered(1.0)
    for bound, least in ((math.inf, 8), (0.0, None)):
        monkeypatch.setattr(compact_planes, "BOUND", bound)
        state = compact(kept.field, kept.renderer, None)
        error = (restored(state, kept.field.planes.shape) - kept.field.planes).abs().amax((-1, -2))
        span = kept.field.planes.amax((-1, -2)) - kept.field.planes.amin((-1, -2))
        assert (error <= 0.51 * span / 255).all() if least else not error.any()
        assert ("planes" in state) == (least is None)
    with torch.no_grad():
        kept.field.planes[0, 1, 0, 2, 2] = torch.nan
    save_field(tmp_path / FIELD, kept)
    assert torch.equal(load_field(tmp_path / FIELD).field.planes.isnan(), kept.field.planes.isnan())
