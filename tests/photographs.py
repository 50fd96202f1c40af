"""Stand-ins for photographs: models on backgrounds as cameras see them, whose true masks are known."""

from pathlib import Path

import numpy as np
from PIL import Image


def noise(size: tuple[int, int], seed: int, roughness: float = 1.6) -> np.ndarray:
    """Colours in [0, 1] with a photograph's spectrum, darker below [height, width, 3]."""
    generator = np.random.default_rng(seed)
    height, width = 192, 256
    frequency = np.hypot(np.fft.fftfreq(height)[:, None], np.fft.fftfreq(width)[None])
    frequency[0, 0] = 1
    layers = []
    for _ in range(2):
        spectrum = np.fft.fft2(generator.normal(size=(height, width))) / frequency**roughness
        layer = np.fft.ifft2(spectrum).real
        layers.append((layer - layer.mean()) / layer.std())
    tints = generator.uniform(0.25, 0.75, (2, 3)) * [[1, 1, 1], [0.8, 1.1, 0.7]]
    mixed = 1 / (1 + np.exp(-1.5 * layers[0]))[..., None]
    colours = mixed * tints[0] + (1 - mixed) * tints[1] + 0.05 * layers[1][..., None]
    colours = colours + np.linspace(0.12, -0.12, height)[:, None, None]
    image = Image.fromarray((colours.clip(0, 1) * 255).astype(np.uint8)).resize(size[::-1], Image.Resampling.BICUBIC)
    grain = generator.normal(0, 0.02, (*size, 1))
    return (np.asarray(image) / 255 + grain).clip(0, 1)


def bricks(size: tuple[int, int], seed: int) -> np.ndarray:
    """A wall whose bricks have edges as an object has, above grey ground [height, width, 3]."""
    generator, (height, width) = np.random.default_rng(seed), size
    tall, long = height // 24, width // 12
    row, column = np.arange(height)[:, None] // tall, np.arange(width)[None]
    column = column + long // 2 * (row % 2)
    tint = generator.uniform(0.75, 1.15, (height // tall + 1, width // long + 2))[row, column // long][..., None]
    mortar = (np.arange(height)[:, None] % tall < tall // 5) | (column % long < long // 10)
    wall = np.where(mortar[..., None], 0.68, tint * [0.59, 0.31, 0.24])
    wall = np.where((np.arange(height)[:, None] > 0.55 * height)[..., None], 0.5, wall)
    return (wall + generator.normal(0, 0.02, (*size, 1))).clip(0, 1)


def photograph(
    model: np.ndarray,
    where: np.ndarray,
    file: Path,
    size: tuple[int, int],
    centre: tuple[float, float],
    share: float,
    seed: int,
    behind: np.ndarray | None = None,
) -> np.ndarray:
    """Write a JPEG of a model before a background, and return its true mask.

    Args:
        model, where: its picture [h, w, 3] of bytes, and what of it is the model.
        size: (height, width) of the photograph.
        centre: (x, y) of the model, as shares.
        share: of the photograph's height that the model's picture takes.
        behind: what lies behind; None: noise.
    """
    side = round(share * size[0])
    colours = np.asarray(Image.fromarray(model).resize((side, side), Image.Resampling.BICUBIC)) / 255
    alpha = (
        np.asarray(Image.fromarray((where * 255).astype(np.uint8)).resize((side, side), Image.Resampling.BICUBIC)) / 255
    )
    picture, mask = noise(size, seed) if behind is None else behind, np.zeros(size, bool)
    top, left = round(centre[1] * size[0] - side / 2), round(centre[0] * size[1] - side / 2)
    part = (slice(top, top + side), slice(left, left + side))
    picture[part] = alpha[..., None] * colours + (1 - alpha[..., None]) * picture[part]
    mask[part] = alpha > 0.5
    Image.fromarray((picture * 255).astype(np.uint8)).save(file, quality=88)
    return mask
