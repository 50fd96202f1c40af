import imageio.v2 as imageio
import numpy as np
import pytest
import torch
from PIL import Image

from nerfdiff.results.pictures import colour_depth, contact_sheet, orbit_video
from nerfdiff.utils.errors import DataError


def colours(n, size=32):
    """n flat images of different colours."""
    generator = torch.Generator().manual_seed(0)
    return torch.rand(n, 3, 1, 1, generator=generator).expand(n, 3, size, size)


def test_contact_sheet_has_each_picture_enlarged_in_its_place(tmp_path):
    left, right = colours(2), 1 - colours(2)
    path = contact_sheet(tmp_path / "new" / "sheet.png", {"input": left, "absent": None, "truth": right}, min_cell=64)
    sheet = np.array(Image.open(path)).astype(int)
    for images in (left, right):
        for image in images:
            level = (image[:, 0, 0] * 255).round().int().numpy()
            ys, xs = np.nonzero((sheet == level).all(-1))
            assert len(ys) == 64 * 64
            assert (np.ptp(ys), np.ptp(xs)) == (63, 63)
    heading = sheet[:20]
    assert (heading < 128).any(), "column headings are drawn above the pictures"


def test_contact_sheet_writes_row_names_on_the_left(tmp_path):
    bare, named = (
        np.array(Image.open(contact_sheet(tmp_path / f"{i}.png", {"truth": torch.ones(2, 3, 32, 32)}, names)))
        for i, names in enumerate([None, ["first car", "second"]])
    )
    margin = named.shape[1] - bare.shape[1]
    assert margin > 20
    assert (named[30:, :margin] < 128).any() and (named[30:, margin:] == 255).all()


def test_contact_sheet_refuses_columns_of_different_shapes(tmp_path):
    with pytest.raises(ValueError, match="one shape"):
        contact_sheet(tmp_path / "sheet.png", {"a": colours(2), "b": colours(3)})


def test_depth_colours_run_from_near_to_far_over_white():
    depth = torch.tensor([[[1.0, 1.5, 2.0, 9.0, torch.nan]]])
    coloured = colour_depth(depth, near=1.0, far=2.0)
    assert coloured.shape == (1, 3, 1, 5)
    near, middle, far, beyond, broken = coloured[0, :, 0].T
    assert near[0] > near[2] and far[2] > far[0] and middle[1] > 0.8  # turbo: red, green, blue
    assert torch.equal(far, beyond) and torch.equal(far, broken)
    assert coloured.min() >= 0 and coloured.max() <= 1
    faded = colour_depth(depth, 1.0, 2.0, opacity=torch.tensor([[[1.0, 0.5, 0.0, 0.0, 0.0]]]))[0, :, 0].T
    torch.testing.assert_close(faded[0], near)
    assert (faded[2:] == 1).all()
    torch.testing.assert_close(faded[1], (middle + 1) / 2)


@pytest.mark.parametrize(
    ("height", "width", "size"), [(32, 32, (256, 256)), (129, 131, (262, 258)), (301, 299, (300, 302))]
)
def test_orbit_video_plays_back_what_went_in(tmp_path, height, width, size):
    frames = torch.zeros(5, 3, height, width)
    for i in range(5):
        frames[i, :, : height // 2] = i / 4
    path = orbit_video(tmp_path / "orbit.mp4", frames, fps=10)
    with imageio.get_reader(path) as reader:
        facts = reader.get_meta_data()
        back = np.stack([frame for frame in reader]).astype(float)  # noqa: C416 (its length is infinite)
    assert facts["size"] == size and facts["codec"] == "h264" and facts["fps"] == 10
    assert "yuv420p" in facts["pix_fmt"]
    assert len(back) == 5
    for i in range(5):
        assert back[i, 10].mean() == pytest.approx(i / 4 * 255, abs=8)
        assert back[i, -10].mean() == pytest.approx(0, abs=8)


def test_pictures_that_cannot_be_written_are_named(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(DataError, match=r"cannot write .*sheet\.png"):
        contact_sheet(tmp_path / "file" / "sheet.png", {"a": colours(1)})
