"""Elevations are estimated from features, and how well is measured on images that the estimate has not seen."""

import os
from dataclasses import replace

import pytest
import torch

from nerfdiff.stability.elevation import Elevation
from nerfdiff.stability.facts import FACTS
from nerfdiff.stability.familiar import FAMILIAR, Familiar


@pytest.fixture(scope="module")
def images():
    """Features of which three have to do with the elevation, and elevations of 0 to 90 degrees."""
    draws = torch.Generator().manual_seed(0)
    found = torch.randn(400, 40, generator=draws)
    degrees = (45 + 12 * found[:, :3].sum(1) + 2 * torch.randn(400, generator=draws)).clamp(0, 90)
    return found, degrees


def test_elevations_are_estimated_better_than_by_their_median(images):
    found, degrees = images
    fit = Elevation.of(found, degrees)
    missed = (Elevation.of(found[:300], degrees[:300])(found[300:]) - degrees[300:]).abs()
    assert fit.error == pytest.approx(float(missed.mean()), rel=0.3) and fit.error < 4 < 10 < fit.spread and fit.useful
    assert (missed <= fit.most).float().mean() == pytest.approx(0.9, abs=0.08)
    assert (fit.low, fit.high) == (float(degrees.min()), float(degrees.max()))
    assert float(fit(100 * found).max()) == fit.high  # what no training image has is not said


def test_where_features_say_nothing_the_error_says_so(images):
    found, degrees = images
    fit = Elevation.of(found[:, 3:], degrees)
    assert fit.error > 0.85 * fit.spread and not fit.useful


def test_it_is_kept_with_what_is_familiar_and_images_of_unknown_elevation_are_left_out(images, tmp_path):
    found, degrees = images
    known = torch.randn(400, 17, generator=torch.Generator().manual_seed(1))
    some = degrees.clone()
    some[::4] = torch.nan
    familiar = replace(Familiar.of(found, 8, known), elevation=Elevation.of(found, some))
    familiar.save(tmp_path / "familiar.safetensors")
    loaded = Familiar.load(tmp_path / "familiar.safetensors")
    assert torch.equal(loaded.elevation(found), familiar.elevation(found)) and loaded.elevation.error < 5
    assert loaded.elevation.most == familiar.elevation.most
    assert Elevation.of(found, torch.full_like(degrees, torch.nan)) is None
    replace(familiar, elevation=None).save(tmp_path / "familiar.safetensors")
    assert Familiar.load(tmp_path / "familiar.safetensors").elevation is None


def test_a_file_beside_weights_is_read_again_only_when_it_changed(tmp_path):
    weights, file = tmp_path / "model.safetensors", tmp_path / FAMILIAR
    assert Familiar.beside(weights) is None
    known = Familiar(torch.zeros(3), torch.eye(3)[:, :1], torch.ones(1), 1.0, 1.0, torch.zeros(len(FACTS), 3))
    known.save(file)
    first = Familiar.beside(weights)
    assert first.usual == 1 and Familiar.beside(weights) is first
    replace(known, usual=2.0).save(file)
    os.utime(file, (1, 1))
    assert Familiar.beside(weights).usual == 2
