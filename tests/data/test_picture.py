"""One picture as input, against areas worked out by hand and cameras written out."""

import numpy as np
import pytest
import torch
from PIL import Image

from nerfdiff.data.picture import Picture, area_resample, scene_id
from nerfdiff.data.readers.srn import SRNReader
from nerfdiff.utils.errors import ConfigError, DataError

SETTINGS = {
    "mask": None,
    "open_border": 0.5,
    "speck": 0.02,
    "smallest": 8,
    "fov": 52.0,
    "near": 0.8,
    "far": 1.8,
    "object_share": None,
    "object_centre": [0.5, 0.5],
    "white": 0.95,
    "white_border": 0.9,
}
COLOUR = (200, 30, 60)


def picture(**changes) -> Picture:
    return Picture(**(SETTINGS | changes))


def load(path, size=(32, 32), **changes) -> np.ndarray:
    """The framed picture, [height, width, 3]."""
    return picture(**changes).load(path, size).source_pixels[0].movedim(0, -1).numpy()


def rgba(height: int, width: int, box: tuple[int, int, int, int], hidden=(0, 0, 0)) -> Image.Image:
    """A rectangle (top, left, bottom, right) on transparency, under which lies `hidden`."""
    image = np.zeros((height, width, 4), np.uint8)
    image[..., :3] = hidden
    image[box[0] : box[2], box[1] : box[3]] = (*COLOUR, 255)
    return Image.fromarray(image)


def bounds(image: np.ndarray) -> tuple[int, int, int, int]:
    """(top, left, bottom, right) of what is not white."""
    rows, columns = (np.flatnonzero((image < 250).any(-1).any(axis)) for axis in (1, 0))
    return rows[0], columns[0], rows[-1] + 1, columns[-1] + 1


def disc_coverage(size: int, centre: tuple[float, float], radius: float) -> np.ndarray:
    """Area of each pixel inside a disc: its chords, exact along x, at 64 heights in each row."""
    y = (np.arange(size * 64) + 0.5) / 64 - centre[0]
    half = np.sqrt(np.maximum(radius**2 - y**2, 0))[:, None]
    edges = np.arange(size + 1) - centre[1]
    return np.diff(edges.clip(-half, half), axis=1).reshape(size, 64, size).mean(1)


@pytest.mark.parametrize(("side", "tolerance"), [(320, 1.6), (499, 6)])  # a pixel on the edge may lie in two new ones
@pytest.mark.parametrize("hidden", [(0, 0, 0), (255, 255, 255), (0, 255, 0)])
def test_a_disc_covers_what_it_covers(tmp_path, side, tolerance, hidden):
    """Premultiplied: what lies under transparency leaves no fringe, be it black or green."""
    alpha = disc_coverage(side, (0.45 * side, 0.55 * side), 0.3 * side)
    image = np.empty((side, side, 4), np.uint8)
    image[..., :3] = np.where(alpha[..., None] > 0, COLOUR, hidden)
    image[..., 3] = np.rint(255 * alpha)
    Image.fromarray(image).save(tmp_path / "disc.png")
    coverage = disc_coverage(32, (0.45 * 32, 0.55 * 32), 0.3 * 32)[..., None]
    expected = coverage * np.array(COLOUR) + (1 - coverage) * 255
    assert np.abs(load(tmp_path / "disc.png") - expected).max() < tolerance


@pytest.mark.parametrize("window", [(0, 0, 12, 20), (-3.25, 2.5, 11.0, 22.0), (1.3, -4.7, 9.1, 13.0)])
def test_shrinking_averages_areas_exactly(window):
    pixels = np.random.default_rng(0).integers(0, 256, (12, 20, 3), dtype=np.uint8)
    found = area_resample(pixels, window, (4, 5))
    top, left, tall, wide = window
    for i in range(4):
        for j in range(5):
            total, step = np.zeros(3), (tall / 4, wide / 5)
            rows = (top + i * step[0], top + (i + 1) * step[0])
            columns = (left + j * step[1], left + (j + 1) * step[1])
            for y in range(-9, 30):
                for x in range(-9, 40):
                    covered = max(0, min(y + 1, rows[1]) - max(y, rows[0])) * max(
                        0, min(x + 1, columns[1]) - max(x, columns[0])
                    )
                    colour = pixels[y, x] if 0 <= y < 12 and 0 <= x < 20 else 255.0
                    total += covered * colour
            assert np.abs(found[i, j] - total / (step[0] * step[1])).max() <= 0.51


def test_growing_interpolates_linearly():
    ramp = np.broadcast_to((10 * np.arange(9, dtype=np.uint8))[None, :, None], (9, 9, 3))
    grown = area_resample(ramp, (0, 0, 9, 9), (9, 36))[4, :, 0].astype(float)
    inner = slice(4, -4)  # the outermost ones reach beyond the image, into white
    assert np.abs(grown - 10 * ((np.arange(36) + 0.5) / 4 - 0.5))[inner].max() <= 0.51


def test_other_shapes_are_padded_with_white(tmp_path):
    rgba(40, 80, (0, 0, 40, 80)).save(tmp_path / "wide.png")
    rgba(66, 36, (3, 3, 63, 33)).save(tmp_path / "tall.png")
    assert bounds(load(tmp_path / "tall.png", (33, 33))) == (1, 9, 32, 24)
    assert bounds(load(tmp_path / "tall.png", (22, 44))) == (1, 17, 21, 27)
    Image.open(tmp_path / "wide.png").save(tmp_path / "wide.webp", lossless=True)
    with pytest.raises(DataError, match="border is not white"):  # opaque all over, alpha or not
        load(tmp_path / "wide.png")
    mask = np.zeros((40, 80), np.uint8)
    mask[:, 20:60] = 255
    Image.fromarray(mask).save(tmp_path / "most.png")
    wide = load(tmp_path / "wide.webp", mask=str(tmp_path / "most.png"))
    assert bounds(wide) == (8, 8, 24, 24)
    assert (wide[8:24, 8:24] == COLOUR).all() and (wide[:8] == 255).all()
    assert bounds(load(tmp_path / "wide.webp", (20, 40), mask=str(tmp_path / "most.png"))) == (0, 10, 20, 30)


@pytest.mark.parametrize(("share", "centre"), [(0.5, (0.5, 0.5)), (0.75, (0.5, 0.5)), (0.5, (0.375, 0.625))])
@pytest.mark.parametrize("box", [(10, 20, 40, 100), (0, 0, 50, 30), (70, 95, 90, 115)])
def test_the_object_is_put_where_it_is_asked_for(tmp_path, share, centre, box):
    rgba(90, 120, box).save(tmp_path / "a.png")
    height, width = 40, 64
    image = load(tmp_path / "a.png", (height, width), object_share=share, object_centre=centre)
    tall, wide = box[2] - box[0], box[3] - box[1]
    scale = share / max(tall / height, wide / width)
    half = np.array([tall, wide]) * scale / 2
    middle = np.array([centre[1] * height, centre[0] * width])
    expected = np.concatenate([middle - half, middle + half])
    blur = max(scale - 1, 0) / 2  # where it is enlarged
    assert np.abs(np.array(bounds(image)) - expected).max() < 1 + blur
    ink = (255 - image.astype(float)).sum() / (255 - np.array(COLOUR)).sum()
    assert ink == pytest.approx(tall * wide * scale**2, rel=0.01)


def test_a_mask_cuts_the_object_out(tmp_path):
    noise = np.random.default_rng(0).integers(0, 200, (64, 64, 3), dtype=np.uint8)
    Image.fromarray(noise).save(tmp_path / "photo.png")
    mask = np.zeros((64, 64), np.uint8)
    mask[16:32, 8:40] = 255
    Image.fromarray(mask).save(tmp_path / "mask.png")
    image = load(tmp_path / "photo.png", (64, 64), mask=str(tmp_path / "mask.png"))
    assert np.array_equal(image, np.where(mask[..., None] > 0, noise, 255))
    framed = load(tmp_path / "photo.png", (64, 64), mask=str(tmp_path / "mask.png"), object_share=0.5)
    assert np.array_equal(framed[24:40, 16:48], noise[16:32, 8:40])
    part_white = noise.copy()
    part_white[16:20] = 255  # where the mask has the object all the same
    Image.fromarray(part_white).save(tmp_path / "white.png")
    white = load(tmp_path / "white.png", (64, 64), mask=str(tmp_path / "mask.png"), object_share=0.5)
    assert bounds(white) == (28, 16, 40, 48)
    see_through = np.dstack([noise, np.where(np.arange(64) < 24, 255, 0)[None].repeat(64, 0).astype(np.uint8)])
    Image.fromarray(see_through).save(tmp_path / "both.png")
    both = load(tmp_path / "both.png", (64, 64), mask=str(tmp_path / "mask.png"), object_share=0.5)
    # 16 x 16 pixels are left of the object, enlarged twofold and so blurred by half a new pixel
    assert bounds(both) == (15, 15, 49, 49)
    assert (both[17:47, 17:47] < 250).any(-1).all()


@pytest.mark.parametrize("mode", ["RGB", "L", "P", "I;16", "RGBA", "CMYK"])
def test_on_white_the_object_is_what_is_not(tmp_path, mode):
    grey = np.full((40, 40), 250, np.uint8)
    grey[10:30, 4:24] = 30
    image = Image.fromarray(grey).convert("RGB")
    if mode == "I;16":
        image = Image.fromarray(grey.astype(np.uint16) * 257)
    else:
        image = image.quantize(4) if mode == "P" else image.convert(mode)
    image.save(tmp_path / "a.tiff")
    framed = load(tmp_path / "a.tiff", (40, 40), object_share=0.5)
    assert (framed[10:30, 10:30] == 30).all() and (framed[:10] > 245).all() and (framed[:, 30:] > 245).all()


def clean(side: int = 64) -> np.ndarray:
    """A dark disc with a white hole on white, off the middle."""
    y, x = np.mgrid[:side, :side] + 0.5
    distance = np.hypot(y - 0.45 * side, x - 0.4 * side)
    return np.where(((distance < 0.3 * side) & (distance > 0.1 * side))[..., None], COLOUR, 255).astype(np.uint8)


def cut_out(colours: np.ndarray) -> np.ndarray:
    """The same with transparency for white."""
    return np.dstack([colours, np.where((colours == 255).all(-1), 0, 255).astype(np.uint8)])


def dust(image: np.ndarray, ink: tuple[int, ...]) -> np.ndarray:
    image = image.copy()
    image[-3:-1, -3:-1] = image[1:3, 1:3] = ink
    return image


def text(image: np.ndarray) -> np.ndarray:
    """Strokes of a watermark."""
    image = image.copy()
    image[-6:-3, 30:60:4] = 90
    return image


def haze(image: np.ndarray) -> np.ndarray:
    """What programs that cut out leave: a little alpha everywhere, and soft blots."""
    image = image.copy()
    image[image[..., 3] == 0] = (0, 0, 0, 4)
    image[55:60, 55:60] = (0, 0, 0, 90)
    return image


def round_corners(image: np.ndarray) -> np.ndarray:
    y, x = np.mgrid[: len(image), : len(image)]
    far = np.minimum(y, y[::-1]) + np.minimum(x, x[:, ::-1]) < 6
    return np.dstack([image, np.where(far, 0, 255).astype(np.uint8)])


UNTIDY = {
    "dust": dust(clean(), (120, 120, 120)),
    "watermark": text(clean()),
    "near-white background": np.where(clean() == 255, 253, clean()).astype(np.uint8),
    "rounded corners": round_corners(clean()),
    "dust of a cut-out": dust(cut_out(clean()), (30, 30, 30, 255)),
    "haze of a cut-out": haze(cut_out(clean())),
    "alpha that says nothing": np.dstack([clean(), np.full((64, 64), 255, np.uint8)]),
}


@pytest.mark.parametrize("share", [None, 0.65])
@pytest.mark.parametrize("name", UNTIDY)
def test_specks_and_shades_of_white_change_nothing(tmp_path, name, share):
    for file, array in (("clean", clean()), ("untidy", UNTIDY[name])):
        Image.fromarray(array).save(tmp_path / f"{file}.png")
    expected, found = (load(tmp_path / f"{file}.png", object_share=share) for file in ("clean", "untidy"))
    hole = {"near-white background": 2}.get(name, 0)  # what is enclosed may be the object's and stays as it is
    assert np.abs(found.astype(int) - expected).max() <= hole
    assert (found[0] == 255).all() and (found[:, -1] == 255).all()


def test_specks_of_a_mask_are_left_out_and_the_box_is_told(tmp_path, caplog):
    Image.fromarray(np.random.default_rng(0).integers(0, 200, (64, 64, 3), dtype=np.uint8)).save(tmp_path / "photo.png")
    mask = np.zeros((64, 64), np.uint8)
    mask[20:40, 10:30] = mask[44:50, 10:20] = 255  # a second part of 15 % is the object's
    Image.fromarray(mask).save(tmp_path / "mask.png")
    mask[60:62, 60:62] = mask[3, 3] = 255
    Image.fromarray(mask).save(tmp_path / "specks.png")
    with caplog.at_level("INFO"):
        pair = [load(tmp_path / "photo.png", mask=tmp_path / f"{n}.png", object_share=0.5) for n in ("mask", "specks")]
    assert np.array_equal(*pair)
    assert "photo.png: the object fills rows 20 to 50, columns 10 to 30 of 64x64" in caplog.messages[0]
    assert caplog.messages[0].endswith("64x64") and "left out 2 specks of 5 pixels" in caplog.messages[1]


@pytest.mark.parametrize("cut_by_frame", [False, True])
def test_an_inverted_mask_is_refused(tmp_path, cut_by_frame):
    mask = np.zeros((64, 64), np.uint8)
    mask[20 : 64 if cut_by_frame else 50, 10:50] = 255
    Image.fromarray(np.where(mask[..., None] > 0, COLOUR, 255).astype(np.uint8)).save(tmp_path / "car.png")
    for name, array in (("right", mask), ("inverted", 255 - mask)):
        Image.fromarray(array).save(tmp_path / f"{name}.png")
    assert (load(tmp_path / "car.png", mask=tmp_path / "right.png") < 250).any()
    with pytest.raises(DataError, match=r"inverted\.png: .*car\.png.* found a mask that is white on .* inverted"):
        load(tmp_path / "car.png", mask=tmp_path / "inverted.png")


def test_frames_without_an_object_are_refused(tmp_path):
    blank = np.full((64, 64, 3), 255, np.uint8)
    blank[30:32, 30:33] = 40  # a single speck is no object
    Image.fromarray(blank).save(tmp_path / "speck.png")
    with pytest.raises(DataError, match=r"speck\.png: no object in it; .* is 2x3 pixels \(rows 30 to 32, columns 30"):
        load(tmp_path / "speck.png")
    Image.fromarray(np.where(clean() == 255, 255, 250).astype(np.uint8)).save(tmp_path / "pale.png")
    mask = np.zeros((64, 64), np.uint8)
    mask[20:40, 10:30] = 255  # beside what is to be seen
    Image.fromarray(mask).save(tmp_path / "mask.png")
    for file, chosen in (("pale", None), ("pale", tmp_path / "mask.png")):
        with pytest.raises(DataError, match=rf"{file}\.png: no object in it"):
            load(tmp_path / f"{file}.png", mask=chosen)
    photo = np.random.default_rng(0).integers(0, 200, (64, 64, 3), dtype=np.uint8)
    Image.fromarray(round_corners(photo)).save(tmp_path / "rounded.png")
    with pytest.raises(DataError, match=r"rounded\.png: \d+% of its border is not white, and only \d+% is transparent"):
        load(tmp_path / "rounded.png")


@pytest.mark.parametrize("orientation", range(1, 9))
def test_exif_orientation(tmp_path, orientation):
    """As the standard words it: which sides of the scene the stored first row and first column are."""
    upright = np.full((24, 24, 3), 255, np.uint8)
    upright[2:20, 3:8], upright[15:20, 3:15] = (200, 0, 0), (0, 0, 200)  # an L
    sides = {1: "TL", 2: "TR", 3: "BR", 4: "BL", 5: "LT", 6: "RT", 7: "RB", 8: "LB"}[orientation]
    stored = upright if sides[0] in "TB" else upright.swapaxes(0, 1)
    stored = stored[:: -1 if sides[0] in "BR" else 1, :: -1 if sides[1] in "BR" else 1]
    exif = Image.Exif()
    exif[0x0112] = orientation
    white = (stored == 255).all(-1)
    for name, array in (("rgb", stored), ("rgba", np.dstack([stored, np.where(white, 0, 255).astype(np.uint8)]))):
        Image.fromarray(np.ascontiguousarray(array)).save(tmp_path / f"{name}.png", exif=exif)
        assert np.array_equal(load(tmp_path / f"{name}.png", (24, 24)), upright)
        # its box of 18 x 12 pixels, at scale 1
        framed = load(tmp_path / f"{name}.png", (36, 36), object_share=0.5)
        assert np.array_equal(framed[9:27, 12:24], upright[2:20, 3:15]) and (framed[:9] == 255).all()
    Image.fromarray(np.where(white, 0, 255).astype(np.uint8)).save(tmp_path / "mask.png", exif=exif)
    assert np.array_equal(load(tmp_path / "rgb.png", (24, 24), mask=tmp_path / "mask.png"), upright)


def test_a_view_of_its_own(tmp_path):
    """Cameras, bounds and names, as the reader of SRN's files gives them for SRN's focal length of 131.25 at 128."""
    folder = tmp_path / "cars_test" / "one"
    for name in ("rgb", "pose"):
        (folder / name).mkdir(parents=True)
    image = Image.new("RGB", (128, 128), "white")
    image.paste(COLOUR, (30, 40, 90, 80))
    image.save(folder / "rgb" / "000000.png")
    (folder / "pose" / "000000.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1")
    (folder / "intrinsics.txt").write_text("131.25 64 64 0.\n0. 0. 0.\n1.\n128 128\n")
    settings = {"category": "cars", "near": 0.8, "far": 1.8, "crop": None}
    true = SRNReader(root=tmp_path, split="test", image_size=32, **settings).load(0)
    batch = picture(fov=51.98948897809546).load(folder / "rgb" / "000000.png", (32, 32))
    assert torch.equal(batch.source_pixels, true.pixels)
    assert torch.equal(batch.target_pixels[0], true.pixels)
    torch.testing.assert_close(batch.source_cameras.K, true.cameras.K)
    torch.testing.assert_close(batch.target_cameras.K[0], true.cameras.K)
    assert torch.equal(batch.source_cameras.c2w, torch.eye(4)[None])
    assert torch.equal(batch.target_cameras.c2w, torch.eye(4)[None, None])
    assert (batch.source_cameras.height, batch.source_cameras.width) == (32, 32)
    assert (batch.near.tolist(), batch.far.tolist()) == ([pytest.approx(0.8)], [pytest.approx(1.8)])
    assert batch.scene_ids == ("000000",) and batch.target_views == (batch.source_views,)
    narrow = picture(fov=90.0).load(folder / "rgb" / "000000.png", (32, 64)).source_cameras
    assert narrow.K[0].tolist() == [[pytest.approx(16), 0, 32], [0, pytest.approx(16), 16], [0, 0, 1]]


@pytest.mark.parametrize(
    ("name", "expected"),
    [("car.png", "car"), ("my red car (1).v2.jpg", "my_red_car_1_.v2"), (".png", "png"), ("..", "picture")],
)
def test_ids_name_folders(tmp_path, name, expected):
    assert scene_id(tmp_path / name) == expected
    assert len(scene_id(tmp_path / ("x" * 200 + ".png"))) <= 64


def test_errors_name_the_file_and_what_to_do(tmp_path):
    with pytest.raises(DataError, match=r"none\.png: no such image"):
        load(tmp_path / "none.png")
    (tmp_path / "broken.png").write_bytes(b"no image")
    with pytest.raises(DataError, match=r"broken\.png: an image of an unsupported format"):
        load(tmp_path / "broken.png")
    Image.new("RGB", (20, 10), (90, 90, 90)).save(tmp_path / "street.jpg")
    with pytest.raises(DataError, match=r"street\.jpg: 100% of its border is not white.*RGBA.*picture\.mask"):
        load(tmp_path / "street.jpg")
    Image.new("L", (10, 20), 255).save(tmp_path / "mask.png")
    with pytest.raises(DataError, match=r"mask\.png: a mask of 20x10 for .*street\.jpg of 10x20"):
        load(tmp_path / "street.jpg", mask=str(tmp_path / "mask.png"))
    for name, image in (("clear", rgba(9, 9, (0, 0, 0, 0))), ("white", Image.new("RGB", (9, 9), "white"))):
        image.save(tmp_path / f"{name}.png")
        with pytest.raises(DataError, match=rf"{name}\.png: no object in it"):
            load(tmp_path / f"{name}.png")
    for level, found in ((0, "all black"), (255, "all white")):
        Image.new("L", (20, 10), level).save(tmp_path / "mask.png")
        with pytest.raises(DataError, match=rf"mask\.png: .*street\.jpg .*found a mask that is {found}"):
            load(tmp_path / "street.jpg", mask=str(tmp_path / "mask.png"))


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("fov", 180.0),
        ("near", 2.0),
        ("object_share", 0.0),
        ("object_share", 1.2),
        ("object_centre", [0.5, 1.5]),
        ("white", 0.0),
        ("white_border", 1.1),
        ("open_border", 0.0),
        ("speck", -0.1),
        ("smallest", 0),
    ],
)
def test_impossible_settings(key, value):
    with pytest.raises(ConfigError, match=rf"picture\.{key}="):
        picture(**{key: value})
