import numpy as np
import pytest

from nerfdiff.data.readers.framing import Framing
from nerfdiff.utils.errors import ConfigError, DataError

K = np.array([[50.0, 0, 27.0], [0, 48.0, 21.5], [0, 0, 1]])


def pixel(K, point):
    u, v, w = K @ point
    return u / w, v / w


@pytest.mark.parametrize(
    ("crop", "size"), [(None, None), ([20, 30], None), (None, [20, 28]), ([20, 30], [10, 60]), (24, 12)]
)
def test_a_marked_pixel_stays_under_its_point(crop, size):
    """A lone bright block is found where the framed intrinsics project the point that made it."""
    point = np.array([0.06, -0.09, 1.0])
    u, v = pixel(K, point)  # (30, 17.18)
    image = np.zeros((40, 56, 3), np.uint8)
    image[int(v) - 1 : int(v) + 2, int(u) - 1 : int(u) + 2] = 255
    framing = Framing.of(crop, size)
    framed = framing.image(image)[..., 0].astype(float)
    rows, columns = np.mgrid[: framed.shape[0], : framed.shape[1]] + 0.5
    centroid = (framed * columns).sum() / framed.sum(), (framed * rows).sum() / framed.sum()
    scale = np.array(framed.shape[::-1]) / (np.array([40, 56] if crop is None else np.broadcast_to(crop, 2))[::-1])
    expected = np.array(pixel(framing.K(K, 40, 56), point))
    offset = np.array([int(u) + 0.5 - u, int(v) + 0.5 - v]) * scale  # of the block's centre from the point
    np.testing.assert_allclose(centroid, expected + offset, atol=0.15)


def test_truth_is_framed_as_the_image_is():
    image = np.zeros((12, 16, 3), np.uint8)
    image[4:8, 4:8] = 255
    framing = Framing.of(8, 4)
    np.testing.assert_array_equal(framing.values(image[..., 0] > 0), framing.image(image)[..., 0] > 127)


def test_an_odd_remainder_is_cut_the_same_from_image_and_intrinsics():
    columns = np.broadcast_to(np.arange(7, dtype=np.uint8)[:, None], (5, 7, 3))
    framing = Framing.of([4, 4], None)
    first = int(framing.image(columns)[0, 0, 0])
    assert framing.K(np.diag([1.0, 1.0, 1.0]), 5, 7)[0, 2] == -first


def test_impossible_values():
    for value in (0, -1, [1, 2, 3], [4, -4]):
        with pytest.raises(ConfigError, match="neither a side in pixels nor"):
            Framing.of(None, value)
    with pytest.raises(
        DataError, match=r"crop of 50x50 does not fit into images of 40x56; make data\.reader\.crop smaller"
    ):
        Framing.of(50, None).image(np.zeros((40, 56, 3), np.uint8))
