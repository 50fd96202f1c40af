"""Decoding and resizing against values worked out by hand."""

import struct
import zlib

import numpy as np
import pytest
from PIL import Image

from nerfdiff.data.formats.images import decode, decode_with_alpha, resize, resize_nearest, stored_size
from nerfdiff.data.readers.masks import read_mask
from nerfdiff.utils.errors import DataError


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


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"\0\0\0\x18ftypheic\0\0\0\0mif1heic", r"unsupported format \('heic'\), or none; convert it to PNG, JPEG"),
        (b"v/1\x01\x02\0\0\0channels", "unsupported format .*convert it"),
        (b"<html>\n<head>", "unsupported format .*begins with b'<html>.*or none"),
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:4d7a", "git lfs pull"),
        (b"", r"not a whole image \(empty\)"),
        (b"\x89PNG\r\n", r"not a whole image \(a damaged PNG\)"),
    ],
)
def test_other_formats_are_not_called_damaged(tmp_path, content, message):
    (tmp_path / "a.png").write_bytes(content)
    for read in (decode, read_mask, stored_size):
        with pytest.raises(DataError, match=rf"a\.png: .*{message}") as error:
            read(tmp_path / "a.png")
        assert "\n" not in str(error.value)


@pytest.mark.parametrize("values", [np.ones((4, 5), np.float32), np.full((4, 5), 70000, np.int32)])
def test_pixels_that_8_bits_would_cut_off_are_refused(tmp_path, values):
    Image.fromarray(values).save(tmp_path / "a.tiff")
    with pytest.raises(DataError, match=r"a\.tiff: .*8 or 16 bits"):
        decode(tmp_path / "a.tiff")


ORIENTATIONS = {  # what EXIF says of the stored pixels, as numpy would put them upright
    2: lambda a: a[:, ::-1],
    3: lambda a: a[::-1, ::-1],
    4: lambda a: a[::-1],
    5: lambda a: a.transpose(1, 0, 2),
    6: lambda a: np.rot90(a, -1),
    7: lambda a: np.rot90(a, -1)[::-1],
    8: lambda a: np.rot90(a),
}


def save_oriented(path, pixels: np.ndarray, orientation: int) -> None:
    image = Image.fromarray(pixels)
    exif = image.getexif()
    exif[0x0112] = orientation
    image.save(path, exif=exif)


@pytest.mark.parametrize("orientation", ORIENTATIONS)
def test_images_are_turned_where_only_the_upright_ones_fit_their_camera(tmp_path, rgb, orientation, caplog):
    save_oriented(tmp_path / "a.png", rgb, orientation)
    upright = ORIENTATIONS[orientation](rgb)
    assert np.array_equal(decode(tmp_path / "a.png", (6, 9)), rgb)
    assert np.array_equal(decode(tmp_path / "a.png", (60.0, 90.0)), rgb)
    assert np.array_equal(decode_with_alpha(tmp_path / "a.png", upright=True)[0], upright)
    if orientation > 4:
        assert not caplog.messages
        assert np.array_equal(decode(tmp_path / "a.png", (9, 6)), upright)
        assert np.array_equal(decode(tmp_path / "a.png", (90.0, 60.0)), upright)
    else:
        assert caplog.text.count(f"Orientation of {orientation}") == 1
    for size, stated in ((None, "no size"), ((7, 7), "w x h = 7x7")):
        with pytest.raises(
            DataError, match=rf"a\.png: its EXIF tag Orientation is {orientation} .*stored as 9x6.*{stated}"
        ):
            decode(tmp_path / "a.png", size)


def test_an_exact_size_comes_before_a_similar_aspect(tmp_path):
    pixels = np.random.default_rng(0).integers(0, 256, (100, 101, 3), np.uint8)
    save_oriented(tmp_path / "a.png", pixels, 6)
    assert np.array_equal(decode(tmp_path / "a.png", (100, 101)), pixels)
    assert np.array_equal(decode(tmp_path / "a.png", (101, 100)), np.rot90(pixels, -1))


def test_square_images_are_used_as_stored_with_one_warning(tmp_path, rgb, caplog):
    for name in "ab":
        save_oriented(tmp_path / f"{name}.png", rgb[:6, :6], 6)
        assert np.array_equal(decode(tmp_path / f"{name}.png", (6, 6)), rgb[:6, :6])
    assert caplog.text.count("the stored ones are used") == 1


@pytest.mark.parametrize("orientation", [0, 1, 9])
def test_an_orientation_that_says_nothing_is_no_matter(tmp_path, rgb, orientation):
    save_oriented(tmp_path / "a.png", rgb, orientation)
    assert np.array_equal(decode(tmp_path / "a.png"), rgb)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(DataError, match=r"000009\.png: no such image"):
        decode(tmp_path / "000009.png")


@pytest.mark.parametrize("factors", [(3, 3), (2, 2), (4, 2), (1, 2), (6, 10)])
def test_whole_factors_average_areas_exactly(factors):
    """Rounded once, ties to even: halves occur in a quarter of all blocks of four, and must not make images lighter."""
    pixels = np.random.default_rng(0).integers(0, 256, (40 * factors[0], 40 * factors[1], 3), np.uint8)
    sums = pixels.reshape(40, factors[0], 40, factors[1], 3).sum(axis=(1, 3), dtype=int)
    means = sums / (factors[0] * factors[1])
    assert np.array_equal(resize(pixels, (40, 40)), np.rint(means))
    assert abs((resize(pixels, (40, 40)) - means).mean()) < 0.02


@pytest.mark.parametrize("size", [(90, 90), (240, 240), (180, 180), (80, 160)])
def test_no_size_makes_an_image_lighter_or_darker(size):
    pixels = np.random.default_rng(0).integers(0, 256, (120, 120, 3), np.uint8)
    assert abs(resize(pixels, size).mean() - pixels.mean()) < 0.08


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
