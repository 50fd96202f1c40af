"""One array of an npz, and what is none."""

import numpy as np
import pytest

from data_fixtures import FAR, HEIGHT, NEAR, WIDTH, write_srn
from nerfdiff.data.formats.npz_files import read_array
from nerfdiff.data.readers.srn import SRNReader
from nerfdiff.utils.errors import DataError


def test_one_array_is_read_whatever_the_others_are(tmp_path):
    np.savez_compressed(tmp_path / "a.npz", depth=np.arange(6.0).reshape(2, 3), odd=np.array([{}], dtype=object))
    assert np.array_equal(read_array(tmp_path / "a.npz", "depth", ""), np.arange(6.0).reshape(2, 3))


def saved(**arrays):
    return lambda file: np.savez_compressed(file, **arrays)


def corrupted(file) -> None:
    """Damage within the compressed bytes."""
    np.savez_compressed(file, depth=np.random.default_rng(0).normal(size=(30, 30)))
    content = bytearray(file.read_bytes())
    content[200:240] = bytes(40)
    file.write_bytes(content)


def single(file) -> None:
    with open(file, "wb") as handle:
        np.save(handle, np.zeros(3))


@pytest.mark.parametrize(
    ("write", "message"),
    [
        (lambda file: None, "No such file"),
        (lambda file: file.write_bytes(b""), "No data left"),
        (lambda file: file.write_text("depth"), "expected an npz file"),
        (lambda file: file.mkdir(), "expected an npz file"),
        (corrupted, "expected an npz file"),
        (single, "it is a single array"),
        (saved(mask=np.zeros(3)), "'depth' is not a file|depth is not a file"),
        (saved(depth=np.array([{}], dtype=object)), "Object arrays"),
        (saved(depth=np.array(["a"])), "expected numbers in 'depth' .*found <U1"),
        (saved(depth=np.zeros(3, complex)), "found complex128"),
    ],
    ids=["missing", "empty", "text", "folder", "corrupted", "npy", "other key", "objects", "words", "complex"],
)
def test_what_is_no_such_array(tmp_path, write, message):
    file = tmp_path / "a.npz"
    write(file)
    with pytest.raises(DataError, match=message) as error:
        read_array(file, "depth", "[height, width]")
    assert str(file) in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("depth", "message"),
    [
        (np.ones((HEIGHT, WIDTH - 1)), r"shape 40x55, its image has 40x56"),
        (np.ones(HEIGHT * WIDTH), "finite"),
        (np.full((HEIGHT, WIDTH), np.nan), "finite"),
        (np.full((HEIGHT, WIDTH), -1.0), "at least 0"),
    ],
    ids=["other shape", "flat", "nan", "negative"],
)
def test_srn_depth_that_is_not_of_its_image(tmp_path, depth, message):
    write_srn(tmp_path, {"train": 1}, truth=True)
    np.savez(tmp_path / "cars_train/scene0/depth/000002.npz", depth=depth)
    with pytest.raises(DataError, match=rf"depth/000002\.npz: .*{message}"):
        SRNReader(tmp_path, "cars", "train", NEAR, FAR).load(0, truth=True)
