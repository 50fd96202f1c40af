import logging

import fake_weights
import no_network
import numpy as np
import pytest
import scipy.linalg
import torch
from torchmetrics.image.fid import FrechetInceptionDistance

from nerfdiff.metrics import sets
from nerfdiff.metrics.sets import (
    FrechetDistance,
    GaussianStatistics,
    InceptionFeatures,
    frechet_distance,
    inception_weights,
)


def samples(n, dim, seed, mean=0.0):
    generator = torch.Generator().manual_seed(seed)
    mixing = torch.randn(dim, dim, generator=generator, dtype=torch.float64)
    return torch.randn(n, dim, generator=generator, dtype=torch.float64) @ mixing + mean


def distance_between(a, b):
    distance = FrechetDistance()
    distance.update(a, b)
    return distance.compute()


def scipy_distance(a, b):
    a, b = a.numpy(), b.numpy()
    covariances = np.cov(a, rowvar=False), np.cov(b, rowvar=False)
    root = scipy.linalg.sqrtm(covariances[0] @ covariances[1])
    gap = a.mean(0) - b.mean(0)
    return gap @ gap + np.trace(covariances[0] + covariances[1] - 2 * root.real)


def test_statistics_of_uneven_batches_are_those_of_all_at_once():
    features = samples(101, 6, seed=0, mean=1e6)
    statistics = GaussianStatistics()
    for batch in features.split([1, 40, 7, 0, 53]):
        statistics.update(batch)
    assert statistics.count == 101
    np.testing.assert_allclose(statistics.mean, features.mean(0), rtol=1e-12)
    np.testing.assert_allclose(statistics.covariance, np.cov(features.numpy(), rowvar=False), rtol=1e-6)


def test_distance_is_that_of_scipys_matrix_root():
    a, b = samples(400, 24, seed=1), samples(300, 24, seed=2, mean=0.5)
    assert distance_between(a, b) == pytest.approx(scipy_distance(a, b), rel=1e-9)


def test_distance_is_that_of_torchmetrics():
    class Pixels(torch.nn.Module):
        num_features = 12

        def forward(self, images):
            return images.flatten(1)

    a, b = samples(200, 12, seed=3).float(), samples(150, 12, seed=4, mean=1.0).float()
    theirs = FrechetInceptionDistance(feature=Pixels(), normalize=True)
    theirs.update(a.reshape(-1, 3, 2, 2), real=False)
    theirs.update(b.reshape(-1, 3, 2, 2), real=True)
    assert distance_between(a, b) == pytest.approx(theirs.compute().item(), rel=1e-5)


def test_distance_of_gaussians_with_one_eigenbasis_is_the_closed_form():
    s1, s2 = torch.tensor([4.0, 1.0, 0.25]), torch.tensor([1.0, 9.0, 0.25])
    gap = torch.tensor([1.0, -2.0, 0.5])
    Q, _ = torch.linalg.qr(samples(3, 3, seed=5))
    rotate = lambda variances: Q @ torch.diag(variances.double()) @ Q.T  # noqa: E731
    expected = gap.square().sum() + (s1.sqrt() - s2.sqrt()).square().sum()
    measured = frechet_distance(gap, rotate(s1), torch.zeros(3), rotate(s2))
    assert measured == pytest.approx(expected.item(), rel=1e-12)


def test_distance_is_exact_where_images_are_fewer_than_dimensions():
    """Turning 5-dimensional features into 300 dimensions by an isometry leaves the distance as it is."""
    a, b = samples(40, 5, seed=6), samples(30, 5, seed=7, mean=0.3)
    isometry, _ = torch.linalg.qr(samples(300, 5, seed=8))
    assert distance_between(a @ isometry.T, b @ isometry.T) == pytest.approx(scipy_distance(a, b), rel=1e-9)


def test_distance_of_a_set_to_itself_is_zero_even_when_singular():
    few = samples(20, 200, seed=9)
    assert distance_between(few, few.flip(0)) < 1e-8 * few.square().sum().item()
    constant = torch.ones(5, 8)
    assert distance_between(constant, constant) == 0


def test_distance_needs_two_images_on_each_side():
    assert distance_between(samples(1, 4, seed=0), samples(9, 4, seed=0)) is None
    assert FrechetDistance().compute() is None


def test_inception_features_are_those_of_torchmetrics_fid_without_antialiasing(tmp_path, monkeypatch):
    no_network.block(monkeypatch)
    path = tmp_path / "inception.pth"
    fake_weights.write_inception(path)
    images = torch.randint(0, 256, (2, 3, 32, 32), dtype=torch.uint8)
    features = InceptionFeatures(path)(images)
    fid = FrechetInceptionDistance(feature_extractor_weights_path=str(path), antialias=False)
    with torch.no_grad():
        expected = fid.inception(images)
    assert features.shape == (2, 2048)
    assert features.isfinite().all() and features.std() > 0
    torch.testing.assert_close(features, expected)


def test_fid_says_what_is_missing(tmp_path, monkeypatch, caplog):
    no_network.block(monkeypatch)
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    with caplog.at_level(logging.WARNING):
        assert inception_weights() is None
        monkeypatch.setattr(sets, "find_spec", lambda name: None)
        assert inception_weights() is None
    no_file, no_package = (record.getMessage() for record in caplog.records)
    assert "weights-inception-2015-12-05-6726825d.pth" in no_file and str(tmp_path) in no_file
    assert "torch-fidelity is not installed" in no_package
