"""Decoding and resizing against values worked out by hand."""

import struct
import zlib

import numpy as np
import pytest
from PIL import Image

from nerfdiff.data.images import decode, decode_with_alpha, resize, resize_nearest
from nerfdiff.errors import DataError


def write_png16(path, values: np.ndarray) -> None:
    """A 16-bit PNG, which Pillow does not write in colour."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    colour_type = {1: 0, 3: 2, 4: 6}[values.shape[2]]
    header = struct.pack(">IIBBBBB", values.shape[1], values.shape[0], 16, colour_type, 0, 0, 0)
    rows = b"".join(b"\0" + row.astype(">u2").tobytes() for row in values)
    parts = [chunk(b"IHDR", header), chunk(b"IDAT", zlib.compress(rows)), chunk(b"IEND", b"")]
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(parts))


@pytest.fixture
def rgb() -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (6, 9, 3), dtype=np.uint8)


def test_rgb_is_kept(tmp_path, rgb):
    Image.fromarray(rgb).save(tmp_path / "a.png")
    assert np.array_equal(decode(tmp_path / "a.png"), rgb)


def test_alpha_lies_on_white(tmp_path, rgb):
    alpha = np.random.default_rng(1).integers(0, 256, (6, 9, 1), dtype=np.uint8)
    alpha[0, 0], alpha[0, 1] = 0, 255
    Image.fromarray(np.concatenate([rgb, alpha], -1)).save(tmp_path / "a.png")
    a = alpha / 255.0
    image = decode(tmp_path / "a.png")
    assert np.abs(image - (rgb * a + 255 * (1 - a))).max() <= 0.5
    assert (image[0, 0] == 255).all() and (image[0, 1] == rgb[0, 1]).all()


def test_grey_and_palette(tmp_path, rgb):
    Image.fromarray(rgb[..., 0]).save(tmp_path / "grey.png")
    assert np.array_equal(decode(tmp_path / "grey.png"), np.repeat(rgb[..., :1], 3, -1))
    palette = Image.fromarray(rgb // 128 * 128).quantize(8)
    palette.save(tmp_path / "palette.png")
    assert np.array_equal(decode(tmp_path / "palette.png"), np.asarray(palette.convert("RGB")))
    grey_alpha = np.stack([rgb[..., 0], np.zeros_like(rgb[..., 0])], -1)
    Image.fromarray(grey_alpha, "LA").save(tmp_path / "la.png")
    assert (decode(tmp_path / "la.png") == 255).all()


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_sixteen_bits(tmp_path, rgb, channels):
    values = np.concatenate([rgb, np.full((6, 9, 1), 255)], -1)[..., :channels].astype(np.uint16) * 257
    write_png16(tmp_path / "a.png", values)
    assert np.array_equal(decode(tmp_path / "a.png"), rgb if channels > 1 else np.repeat(rgb[..., :1], 3, -1))


@pytest.mark.parametrize("damage", [lambda b: b[: len(b) // 2], lambda b: b"", lambda b: b"no image at all" * 9])
def test_damaged_files_are_named(tmp_path, rgb, damage):
    path = tmp_path / "000007.png"
    Image.fromarray(rgb).save(path)
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(DataError, match=r"000007\.png") as error:
        decode(path)
    assert "\n" not in str(error.value)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(DataError, match=r"000009\.png: no such image"):
        decode(tmp_path / "000009.png")


def test_whole_factors_average_areas(rgb):
    blocks = rgb[:6, :9].reshape(2, 3, 3, 3, 3).mean(axis=(1, 3))
    assert np.abs(resize(rgb, (2, 3)) - blocks).max() <= 1  # Pillow rounds after each axis


def test_resizing_keeps_the_borders_in_place_and_does_not_alias():
    ramp = np.broadcast_to(np.arange(0, 250, 2, dtype=np.uint8)[None, :, None], (10, 125, 3))
    for width in (50, 40, 200):
        centres = (np.arange(width) + 0.5) * 125 / width  # pixel centres in the old pixels
        inner = slice(width // 10, -width // 10)
        assert np.abs(resize(ramp, (10, width))[3, inner, 0] - 2 * (centres - 0.5)[inner]).max() < 1.1
    stripes = np.zeros((12, 90, 3), np.uint8)
    stripes[:, ::2] = 255
    assert np.abs(resize(stripes, (12, 41))[:, 3:-3].astype(int) - 127).max() < 20


def test_nearest_takes_values_that_exist():
    values = np.arange(24.0).reshape(4, 6)
    assert resize_nearest(values, (4, 6)).tolist() == values.tolist()
    assert resize_nearest(values, (2, 3)).tolist() == [[7, 9, 11], [19, 21, 23]]
    assert resize_nearest(values > 11, (2, 2)).tolist() == [[False, False], [True, True]]


@pytest.mark.parametrize(("old", "new"), [(9, 3), (15, 3), (8, 4), (12, 2), (7, 5), (5, 7), (6, 18), (135, 16)])
def test_nearest_is_nearest_to_the_new_centre_and_right_of_a_tie(old, new):
    found = resize_nearest(np.arange(float(old))[None], (1, new))[0]
    for k in range(new):
        # centres, in units of 1 / (2 old new) of the image
        distances = [abs((2 * k + 1) * old - (2 * value + 1) * new) for value in range(old)]
        assert found[k] == max(value for value in range(old) if distances[value] == min(distances))


@pytest.mark.parametrize("mode", ["RGB", "RGBA", "LA", "L", "I;16"])
def test_alpha_comes_with_the_colours(tmp_path, mode, rgb):
    alpha = np.linspace(0, 255, rgb.shape[0] * rgb.shape[1]).reshape(rgb.shape[:2]).astype(np.uint8)
    image = Image.new("I;16", (5, 4)) if mode == "I;16" else Image.fromarray(np.dstack([rgb, alpha])).convert(mode)
    image.save(tmp_path / "x.png")
    pixels, opaque = decode_with_alpha(tmp_path / "x.png")
    assert np.array_equal(pixels, decode(tmp_path / "x.png"))
    assert (opaque is None) == ("A" not in mode)
    if opaque is not None:
        assert np.array_equal(opaque, alpha >= 128)
