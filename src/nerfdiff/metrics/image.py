"""Per-image fidelity: PSNR and SSIM, each by the definition its column is published under, and sharpness."""

import torch
from jaxtyping import Float, Float64, UInt8
from skimage.metrics import structural_similarity
from torch import Tensor
from torch.nn.functional import pad
from torchmetrics.functional.image import structural_similarity_index_measure

SSIM_IMPL = "skimage-uniform7"


def quantise(images: Float[Tensor, "n 3 h w"]) -> UInt8[Tensor, "n 3 h w"]:
    """Clamp to [0, 1] and round to 8 bit."""
    return (images.float().clamp(0, 1) * 255).round().to(torch.uint8)


def dequantise(images: UInt8[Tensor, "n 3 h w"]) -> Float[Tensor, "n 3 h w"]:
    """8 bit to [0, 1]."""
    return images.float() / 255


def psnr(
    predictions: Float[Tensor, "n 3 h w"], truth: Float[Tensor, "n 3 h w"], floor: float = 1e-6
) -> Float64[Tensor, "n"]:
    """Peak signal-to-noise ratio of each image in dB, −10 log10 max(MSE, floor).

    Args:
        floor: keeps equal images (blank scenes) finite; 1e-6 caps the ratio at 60 dB.
    """
    mse = (predictions.double() - truth.double()).square().mean(dim=(1, 2, 3))
    return psnr_of_mse(mse, floor)


def psnr_of_mse(mse: Float[Tensor, "*n"], floor: float = 1e-6) -> Float[Tensor, "*n"]:
    """`psnr` from mean squared errors."""
    return -10 * torch.log10(mse.clamp_min(floor))


def ssim(predictions: Float[Tensor, "n 3 h w"], truth: Float[Tensor, "n 3 h w"]) -> Float64[Tensor, "n"]:
    """SSIM of each image as scikit-image: uniform 7×7 window, sample covariance, borders cropped.

    The choice of pixelNeRF, VisionNeRF and SSDNeRF. Images are at least 7×7.
    """
    pairs = zip(predictions.double().cpu().numpy(), truth.double().cpu().numpy(), strict=True)
    values = [structural_similarity(p, t, data_range=1.0, channel_axis=0) for p, t in pairs]
    return torch.tensor(values, dtype=torch.float64)


def ssim_gaussian(predictions: Float[Tensor, "n 3 h w"], truth: Float[Tensor, "n 3 h w"]) -> Float64[Tensor, "n"]:
    """SSIM of each image with an 11×11 Gaussian window (σ = 1.5) and zero padding.

    The choice of 3D Gaussian Splatting and Splatter Image, whose code pads both images with zeros;
    torchmetrics reflects at the border, so zeros are put there first and that border is cropped again.
    """
    border = 5
    predictions, truth = (pad(x.double(), [border] * 4) for x in (predictions, truth))
    _, full = structural_similarity_index_measure(
        predictions, truth, sigma=1.5, data_range=1.0, reduction="none", return_full_image=True
    )
    return full[..., border:-border, border:-border].mean(dim=(1, 2, 3)).cpu()


def gradient_energy(images: Float[Tensor, "n 3 h w"]) -> Float64[Tensor, "n"]:
    """Sum of the squared differences of neighbouring pixels of each image: along rows and columns, over colours."""
    images = images.double()
    return sum(images.diff(dim=axis).square().sum(dim=(1, 2, 3)) for axis in (-2, -1))


def sharpness(predictions: Float[Tensor, "n 3 h w"], truth: Float[Tensor, "n 3 h w"]) -> list[float | None]:
    """Gradient energy of each image over that of its truth: under 1 is blurred, over 1 noisy; None of a flat truth."""
    energies = zip(gradient_energy(predictions).tolist(), gradient_energy(truth).tolist(), strict=True)
    return [predicted / true if true > 0 else None for predicted, true in energies]
