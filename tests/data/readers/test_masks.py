"""Mask files as trackers, segmenters and mattes write them, against the object that they mark."""

import numpy as np
import pytest
from PIL import Image

from nerfdiff.data.readers.framing import Framing
from nerfdiff.data.readers.masks import border, likely_misreading, read_mask, stacked_masks
from nerfdiff.utils.errors import DataError

Y, X = np.mgrid[:48, :64]
WHERE = (X - 30) ** 2 + (Y - 22) ** 2 < 14**2
OTHER = (X - 6) ** 2 + (Y - 8) ** 2 < 4**2
SOFT = np.clip(255 * (14.5 - np.hypot(X - 30, Y - 22)) / 3 + 127.5, 0, 255).astype(np.uint8)
DAVIS = [0, 0, 0, 128, 0, 0, 0, 128, 0, 128, 128, 0]


def palette(indices: np.ndarray, colours: list[int]) -> Image.Image:
    image = Image.new("P", indices.shape[::-1])
    image.putpalette(colours)
    image.putdata(indices.ravel().tolist())
    return image


def grey(low: float, high: float, dtype=np.uint8) -> Image.Image:
    return Image.fromarray(np.where(WHERE, high, low).astype(dtype))


def colours(background: list[int], here: list[int]) -> Image.Image:
    return Image.fromarray(np.where(WHERE[..., None], here, background).astype(np.uint8))


READ = {
    "black and white": grey(0, 255),
    "0 and 1": grey(0, 1),
    "0 and 38": grey(0, 38),
    "0 and 128": grey(0, 128),
    "one bit": Image.fromarray(WHERE),
    "16 bits": grey(0, 65535, np.uint16),
    "16 bits, 0 and 1": grey(0, 1, np.uint16),
    "palette, index 1 dark red": palette(WHERE * 1, DAVIS),
    "palette, index 1 black": palette(WHERE * 1, [0] * 768),
    "palette, index 3 of few": palette(WHERE * 3, DAVIS),
    "palette of grey, white first": palette(~WHERE * 1, [255, 255, 255, 0, 0, 0]),
    "palette of grey, soft": Image.fromarray(SOFT).quantize(64),
    "palette, 0 transparent": palette(WHERE * 1, DAVIS),
    "alpha": Image.fromarray(np.dstack([np.full((*WHERE.shape, 3), 255), WHERE * 255]).astype(np.uint8)),
    "alpha of a black picture": Image.fromarray(np.dstack([np.zeros((*WHERE.shape, 3)), WHERE * 255]).astype(np.uint8)),
    "grey with alpha": Image.fromarray(np.dstack([WHERE * 90, WHERE * 255]).astype(np.uint8), "LA"),
    "alpha that says nothing": grey(0, 255).convert("RGBA"),
    "colour": grey(0, 255).convert("RGB"),
    "dark red on black": colours([0, 0, 0], [128, 0, 0]),
    "blue on black": colours([0, 0, 0], [0, 0, 255]),
}


@pytest.mark.parametrize("name", READ)
def test_the_object_is_read(tmp_path, name):
    more = {"transparency": 0} if name.endswith("0 transparent") else {}
    READ[name].save(tmp_path / "m.png", **more)
    found = read_mask(tmp_path / "m.png")
    expected = SOFT > 127 if "soft" in name else WHERE
    assert found.dtype == bool and np.array_equal(found, expected)


def test_all_objects_of_a_label_image_are_read(tmp_path):
    palette(np.where(OTHER, 2, WHERE * 1), DAVIS).save(tmp_path / "m.png")
    assert np.array_equal(read_mask(tmp_path / "m.png"), WHERE | OTHER)


@pytest.mark.parametrize("kind", ["matte", "supersampled", "jpeg", "16 bits", "alpha", "thin"])
def test_soft_edges_are_halved(tmp_path, kind):
    file, expected = tmp_path / "m.png", SOFT > 127
    if kind == "16 bits":
        Image.fromarray(SOFT.astype(np.uint16) * 257).save(file)
    elif kind == "jpeg":
        file = tmp_path / "m.jpg"
        Image.fromarray(np.where(WHERE, 255, 0).astype(np.uint8)).save(file, quality=60)
        expected = WHERE
    elif kind == "alpha":
        Image.fromarray(np.dstack([np.full((*SOFT.shape, 3), 70, np.uint8), SOFT])).save(file)
    elif kind == "matte":
        Image.fromarray(SOFT).save(file)
    else:
        fine = WHERE if kind == "supersampled" else WHERE | (np.abs(X - 57) < 2)
        shares = fine.reshape(24, 2, 32, 2).mean((1, 3))
        Image.fromarray((shares * 255).astype(np.uint8)).save(file)  # 0, 63, 127, 191 and 255
        expected = shares > 0.5
    assert np.array_equal(read_mask(file), expected)


LABELS = np.where(OTHER, 2, WHERE * 1)
REFUSED = {
    "labels without a palette": (Image.fromarray(LABELS.astype(np.uint8)), "levels 0, 1, 2; expected two"),
    "void at 255": (Image.fromarray(np.where(OTHER, 255, WHERE * 1).astype(np.uint8)), "levels 0, 1, 255"),
    "a band of unknown": (
        Image.fromarray(np.select([SOFT > 240, np.hypot(X - 30, Y - 22) < 22], [255, 128]).astype(np.uint8)),
        "levels 0, 128, 255",
    ),
    "no background": (grey(1, 2), "levels 1, 2; expected two, of which 0"),
    "two greys": (grey(100, 200), "levels 100, 200"),
    "photograph": (
        Image.fromarray((120 + 100 * np.sin(X / 9.0 + Y / 5.0)).astype(np.uint8)),
        r"\d+ levels from \d+ to \d+, \d\d% of the pixels between.*is it a mask",
    ),
    "colours without black": (colours([0, 0, 200], [200, 0, 0]), r"2 colours, none of them black, first \[\[0, 0, 200"),
    "black at another index": (palette(WHERE * 1, [255, 0, 0, 0, 0, 0]), "indices 0, 1, of which not 0"),
    "half transparent": (
        Image.fromarray(np.dstack([np.zeros((*WHERE.shape, 3)), np.where(WHERE, 200, 90)]).astype(np.uint8)),
        "a mask whose alpha has the levels 90, 200",
    ),
    "NaN": (None, r"levels 0, 1, nan; expected finite"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_no_mask_of_two_levels_is_refused(tmp_path, name):
    image, message = REFUSED[name]
    file = tmp_path / ("m.png" if image else "m.tiff")
    if image is None:
        image = Image.fromarray(np.where(OTHER, np.nan, WHERE * 1).astype(np.float32))
    image.save(file)
    with pytest.raises(DataError, match=message) as error:
        read_mask(file)
    assert str(error.value).startswith(str(file)) and "\n" not in str(error.value)


@pytest.mark.parametrize(("level", "covered"), [(0, False), (1, True), (255, True)])
def test_one_level_is_all_or_nothing(tmp_path, level, covered):
    Image.new("L", (5, 4), level).save(tmp_path / "m.png")
    assert (read_mask(tmp_path / "m.png") == covered).all()


def test_masks_that_cannot_be_those_of_objects():
    nothing, all_of_it = np.zeros_like(WHERE), np.ones_like(WHERE)
    cut = WHERE | (X < 30)  # an object that runs out of the picture
    assert "empty in every view" in likely_misreading([nothing] * 3, 0.5)
    assert "cover all of every view" in likely_misreading([all_of_it] * 3, 0.5)
    assert "border in 2 of 3 views; they look inverted" in likely_misreading([~WHERE, ~WHERE, WHERE], 0.5)
    for masks in ([WHERE, nothing], [WHERE, all_of_it], [cut, cut], [~WHERE, WHERE]):
        assert likely_misreading(masks, 0.5) is None
    assert likely_misreading([cut, cut], 0.2) is not None


def test_the_border_has_each_pixel_once():
    for (height, width), count in {(4, 6): 16, (2, 2): 4, (1, 5): 5, (5, 1): 5}.items():
        mask = np.ones((height, width), bool)
        mask[1:-1, 1:-1] = False
        assert border(mask).all() and border(mask).size == count and not border(~mask).any()


def test_an_alpha_that_is_opaque_everywhere_says_nothing():
    framing, full = Framing.of(None, None), np.ones((4, 5), bool)
    assert stacked_masks([full, full], framing, by_alpha=True) is None
    assert stacked_masks([full, full], framing, by_alpha=False).all()
    assert stacked_masks([full, WHERE[:4, :5]], framing, by_alpha=True).shape == (2, 4, 5)
    assert stacked_masks([full, None], framing, by_alpha=False) is None
