import math

import numpy as np
import pytest
import torch

from nerfdiff.metrics.image import (
    dequantise,
    gradient_energy,
    psnr,
    psnr_of_mse,
    quantise,
    sharpness,
    ssim,
    ssim_gaussian,
)


def picture_pair(n=2, size=16, seed=0):
    """Smooth random pictures and noisy copies of them, 8 bit deep."""
    generator = torch.Generator().manual_seed(seed)
    coarse = torch.rand(n, 3, 4, 4, generator=generator)
    picture = torch.nn.functional.interpolate(coarse, (size, size), mode="bilinear")
    noisy = picture + 0.1 * torch.randn(n, 3, size, size, generator=generator)
    return dequantise(quantise(noisy)), dequantise(quantise(picture))


def ssim_of_window(x, y, weights, cov_norm):
    ux, uy = (weights * x).sum(), (weights * y).sum()
    vx = cov_norm * ((weights * x * x).sum() - ux * ux)
    vy = cov_norm * ((weights * y * y).sum() - uy * uy)
    vxy = cov_norm * ((weights * x * y).sum() - ux * uy)
    c1, c2 = 0.01**2, 0.03**2
    return ((2 * ux * uy + c1) * (2 * vxy + c2)) / ((ux**2 + uy**2 + c1) * (vx + vy + c2))


def test_quantise_rounds_to_the_nearest_level_after_clamping():
    values = torch.tensor([-0.5, 0.0, 0.49 / 255, 0.51 / 255, 99.6 / 255, 1.0, 7.0])
    images = values.expand(1, 3, 1, 7)
    assert quantise(images)[0, 0, 0].tolist() == [0, 0, 0, 1, 100, 255, 255]


def test_every_8_bit_level_survives_a_round_trip_in_any_precision():
    levels = torch.arange(256, dtype=torch.uint8).reshape(1, 1, 1, 256).expand(1, 3, 1, 256)
    assert torch.equal(quantise(dequantise(levels)), levels)
    assert torch.equal(quantise(dequantise(levels).double()), levels)


def test_psnr_of_a_constant_offset_is_the_closed_form():
    truth = torch.full((2, 3, 8, 8), 0.5)
    offsets = torch.tensor([0.1, 0.25])[:, None, None, None]
    expected = [-20 * math.log10(d) for d in (0.1, 0.25)]
    torch.testing.assert_close(psnr(truth + offsets, truth), torch.tensor(expected).double(), atol=1e-5, rtol=0)


@pytest.mark.parametrize("dB", [10.0, 36.0, 45.0, 59.9, 61.0])
def test_psnr_is_that_of_a_naive_loop_and_only_capped(dB):
    noise = np.random.default_rng(0).standard_normal((3, 6, 5)) * 10 ** (-dB / 20)
    predictions, truth = (torch.from_numpy(x)[None] for x in (0.5 + noise, np.full_like(noise, 0.5)))
    total = 0.0
    for predicted, true in zip(predictions.flatten().tolist(), truth.flatten().tolist(), strict=True):
        total += (predicted - true) ** 2
    expected = min(60.0, -10 * math.log10(total / noise.size))
    assert psnr(predictions, truth).item() == pytest.approx(expected, abs=1e-9)
    single = psnr_of_mse(torch.tensor(total / noise.size, dtype=torch.float32))  # as training and distillation log it
    assert single.item() == pytest.approx(expected, abs=1e-4)


def test_psnr_of_equal_images_is_60_dB():
    white = torch.ones(3, 3, 8, 8)
    assert psnr(white, white).tolist() == [60.0, 60.0, 60.0]


def test_psnr_is_per_image_and_not_of_the_pooled_error():
    truth = torch.zeros(2, 3, 8, 8)
    predictions = truth.clone()
    predictions[0] = 0.5
    pooled = -10 * math.log10(0.125)
    assert abs(psnr(predictions, truth).mean().item() - pooled) > 10


def test_ssim_is_that_of_a_naive_loop_over_7x7_windows():
    predictions, truth = picture_pair()
    weights = np.full((7, 7), 1 / 49)
    expected = []
    for p, t in zip(predictions.double().numpy(), truth.double().numpy(), strict=True):
        values = [
            ssim_of_window(p[c, y : y + 7, x : x + 7], t[c, y : y + 7, x : x + 7], weights, 49 / 48)
            for c in range(3)
            for y in range(10)
            for x in range(10)
        ]
        expected.append(np.mean(values))
    np.testing.assert_allclose(ssim(predictions, truth).numpy(), expected, atol=1e-10)


def test_ssim_gaussian_is_that_of_a_naive_loop_with_zero_padding():
    predictions, truth = picture_pair(n=1)
    line = np.exp(-((np.arange(11) - 5) ** 2) / (2 * 1.5**2))
    weights = np.outer(line, line) / line.sum() ** 2
    p, t = (np.pad(x[0].double().numpy(), ((0, 0), (5, 5), (5, 5))) for x in (predictions, truth))
    values = [
        ssim_of_window(p[c, y : y + 11, x : x + 11], t[c, y : y + 11, x : x + 11], weights, 1.0)
        for c in range(3)
        for y in range(16)
        for x in range(16)
    ]
    np.testing.assert_allclose(ssim_gaussian(predictions, truth).numpy(), [np.mean(values)], atol=1e-7)


def test_blank_images_have_finite_scores():
    white, grey = torch.ones(1, 3, 16, 16), torch.full((1, 3, 16, 16), 0.5)
    for metric in (psnr, ssim, ssim_gaussian):
        assert metric(white, white).isfinite().all() and metric(grey, white).isfinite().all()
    assert ssim(white, white).item() == 1
    assert ssim_gaussian(white, white).item() == 1


def test_gradient_energy_is_that_of_a_naive_loop():
    images, _ = picture_pair(size=6)
    for image, measured in zip(images.double(), gradient_energy(images).tolist(), strict=True):
        across = sum(float((image[:, y, x + 1] - image[:, y, x]).square().sum()) for y in range(6) for x in range(5))
        down = sum(float((image[:, y + 1, x] - image[:, y, x]).square().sum()) for y in range(5) for x in range(6))
        assert math.isclose(measured, across + down, rel_tol=1e-9)


def test_sharpness_falls_with_blur_and_rises_with_noise():
    noisy, picture = picture_pair()
    blurred = torch.nn.functional.avg_pool2d(picture, 3, stride=1, padding=1, count_include_pad=False)
    assert all(value < 0.9 for value in sharpness(blurred, picture))
    assert all(value > 1.5 for value in sharpness(noisy, picture))
    assert sharpness(picture, picture) == [1, 1]


def test_sharpness_is_the_square_of_contrast_and_each_image_has_its_own():
    _, picture = picture_pair(n=3)
    contrast = torch.tensor([1.0, 0.5, 0.0])[:, None, None, None]
    faded = 0.5 + contrast * (picture - 0.5)
    np.testing.assert_allclose(sharpness(faded, picture), [1, 0.25, 0], atol=1e-6)


def test_sharpness_of_a_flat_truth_is_not_measured():
    noisy, picture = picture_pair()
    white = torch.ones_like(picture)
    assert sharpness(noisy, white) == [None, None]
    assert sharpness(white, picture) == [0, 0]
