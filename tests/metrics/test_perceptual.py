import hashlib
import logging

import fake_weights
import no_network
import pytest
import torch
from kornia.filters import gaussian_blur2d
from stlpips_pytorch import stlpips

from nerfdiff.metrics.perceptual import LPIPS, LPIPS_VGG, STLPIPS, at_least
from nerfdiff.metrics.weights import WeightsFile
from nerfdiff.utils.errors import DataError


@pytest.fixture(scope="module")
def st_lpips():
    return STLPIPS()


def pictures(n=2, size=32, seed=0):
    return torch.rand(n, 3, size, size, generator=torch.Generator().manual_seed(seed))


def shapes_on_white(size=32):
    image = torch.ones(1, 3, size, size)
    image[:, 0, 6:20, 4:28] = 0.1
    image[:, 1, 10:26, 8:16] = 0.4
    image[:, 2, 18:24, 18:26] = 0.0
    return image


def test_st_lpips_is_that_of_the_package_on_minus_one_to_one(st_lpips):
    published = stlpips.LPIPS(net="vgg", variant="shift_tolerant", verbose=False)
    a, b = pictures(seed=1), pictures(seed=2)
    with torch.no_grad():
        expected = published(2 * a - 1, 2 * b - 1).flatten()
    torch.testing.assert_close(st_lpips(a, b)[0], expected)


def test_st_lpips_of_identical_images_is_zero(st_lpips):
    image = pictures()
    assert st_lpips(image, image)[0].tolist() == [0, 0]


def test_st_lpips_grows_with_blur(st_lpips):
    image = shapes_on_white()
    blurred = [gaussian_blur2d(image, 13, (sigma, sigma)) for sigma in (0.5, 1.0, 2.0, 4.0)]
    distances = torch.cat([st_lpips(b, image)[0] for b in blurred])
    assert distances[0] > 0
    assert (distances.diff() > 0).all()


def test_st_lpips_of_blank_images_is_finite(st_lpips):
    white = torch.ones(1, 3, 32, 32)
    for other in (white, torch.zeros_like(white), shapes_on_white()):
        assert all(value.isfinite().all() for value in st_lpips(other, white))


def test_features_are_the_mean_of_the_activations_relu4_3(st_lpips):
    a, b = pictures(seed=1), pictures(seed=2)
    _, features_a, features_b = st_lpips(a, b)
    for images, features in ((a, features_a), (b, features_b)):
        activations = st_lpips.net.net(st_lpips.net.scaling_layer(2 * images - 1)).relu4_3
        assert features.shape == (2, 512)
        torch.testing.assert_close(features, activations.mean(dim=(2, 3)))


def test_images_too_small_for_the_network_are_enlarged(st_lpips):
    a, b = pictures(size=16, seed=1), pictures(size=16, seed=2)
    enlarge = {"size": (32, 32), "mode": "bilinear", "align_corners": False}
    large = [torch.nn.functional.interpolate(x, **enlarge) for x in (a, b)]
    torch.testing.assert_close(st_lpips(a, b)[0], st_lpips(*large)[0])
    assert at_least(torch.zeros(1, 3, 16, 24), 32).shape == (1, 3, 32, 48)
    assert at_least(torch.zeros(1, 3, 33, 40), 32).shape == (1, 3, 33, 40)


def test_st_lpips_needs_no_network_and_draws_no_random_numbers(monkeypatch):
    no_network.block(monkeypatch)
    before = torch.get_rng_state()
    STLPIPS()
    assert torch.equal(torch.get_rng_state(), before)


def naive_lpips(backbone, linear, a, b):
    """Zhang et al., eq. 1, in float64: layer by layer from the weight files."""
    shift, scale = (
        torch.tensor(values, dtype=torch.float64)[:, None, None]
        for values in ([-0.030, -0.088, -0.188], [0.458, 0.448, 0.450])
    )
    x = torch.stack([2 * a - 1, 2 * b - 1]).double().sub(shift).div(scale)
    total, tap = 0, 0
    for layer in range(30):
        if layer in (4, 9, 16, 23):
            x = torch.nn.functional.max_pool2d(x, 2)
        elif f"features.{layer}.weight" in backbone:
            weight, bias = (backbone[f"features.{layer}.{part}"].double() for part in ("weight", "bias"))
            x = torch.nn.functional.conv2d(x, weight, bias, padding=1)
        else:
            x = x.relu()
        if layer in (3, 8, 15, 22, 29):
            unit = x / x.square().sum(1, keepdim=True).add(1e-8).sqrt()
            squared = (unit[0] - unit[1]).square()
            total += (linear[f"lin{tap}.model.1.weight"][0].double() * squared).sum(0).mean()
            tap += 1
    return total


def test_lpips_is_that_of_its_definition(tmp_path):
    import torchmetrics.functional.image.lpips as torchmetrics_lpips

    backbone = fake_weights.write_vgg16(tmp_path / "vgg16.pth")
    folder = torchmetrics_lpips.__file__.rsplit("/", 1)[0]
    linear = torch.load(f"{folder}/lpips_models/vgg.pth", map_location="cpu", weights_only=True)
    before = torch.get_rng_state()
    lpips = LPIPS(tmp_path / "vgg16.pth")
    assert torch.equal(torch.get_rng_state(), before)
    a, b = pictures(seed=1), pictures(seed=2)
    expected = [naive_lpips(backbone, linear, *pair).item() for pair in zip(a, b, strict=True)]
    torch.testing.assert_close(lpips(a, b), torch.tensor(expected), rtol=1e-4, atol=1e-7)
    assert lpips(a, a).abs().max() == 0


def test_missing_weights_are_named_in_one_line_and_nothing_is_fetched(tmp_path, monkeypatch, caplog):
    no_network.block(monkeypatch)
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    with caplog.at_level(logging.WARNING):
        assert LPIPS_VGG.find() is None
    assert len(caplog.records) == 1
    message = caplog.records[0].getMessage()
    assert "\n" not in message
    for part in ("lpips", "vgg16-397923af.pth", str(tmp_path / "checkpoints"), "metrics.lpips_weights"):
        assert part in message


def test_weights_are_found_in_the_hub_cache_or_where_config_says(tmp_path, monkeypatch):
    content = b"weights"
    digest = hashlib.sha256(content).hexdigest()
    file = WeightsFile(f"https://example.org/net-{digest[:8]}.pth", digest[:8], "m", "metrics.m")
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    (tmp_path / "checkpoints").mkdir()
    for path in (tmp_path / "checkpoints" / file.name, tmp_path / "elsewhere.pth"):
        path.write_bytes(content)
    assert file.find() == tmp_path / "checkpoints" / file.name
    assert file.find(str(tmp_path / "elsewhere.pth")) == tmp_path / "elsewhere.pth"
    assert file.find(tmp_path / "nowhere.pth") is None


def test_damaged_weights_are_refused(tmp_path):
    path = tmp_path / "vgg16-397923af.pth"
    path.write_bytes(b"truncated")
    with pytest.raises(DataError, match=r"vgg16-397923af\.pth.*expected 397923af"):
        LPIPS_VGG.find(path)
