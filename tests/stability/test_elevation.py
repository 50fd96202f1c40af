"""Elevations are estimated from features, and how well is measured on images that the estimate has not seen."""

import pytest
import torch

from nerfdiff.stability.elevation import Elevation
from nerfdiff.stability.familiar import Familiar


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
    missed = (fit(found[1::2]) - degrees[1::2]).abs()
    assert fit.error == pytest.approx(float(missed.mean())) and fit.error < 4 < 10 < fit.spread and fit.useful
    assert (missed <= fit.most).float().mean() == pytest.approx(0.9, abs=0.02)
    assert (fit.low, fit.high) == (float(degrees[::2].min()), float(degrees[::2].max()))
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
    familiar = Familiar.of(found, 8, known, some)
    familiar.save(tmp_path / "familiar.safetensors")
    loaded = Familiar.load(tmp_path / "familiar.safetensors")
    assert torch.equal(loaded.elevation(found), familiar.elevation(found)) and loaded.elevation.error < 5
    assert loaded.elevation.most == familiar.elevation.most
    for unknown in (None, torch.full_like(degrees, torch.nan)):
        assert Familiar.of(found, 8, known, unknown).elevation is None
