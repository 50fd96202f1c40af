"""Depth in EXR files as renderers write them, and damaged ones."""

import numpy as np
import OpenEXR
import pytest

from abo_fixtures import write_exr
from nerfdiff.data.formats.exr import read_exr
from nerfdiff.utils.errors import DataError


@pytest.mark.parametrize("half", [False, True])
def test_exr_files_as_renderers_write_them(tmp_path, half):
    values = np.random.default_rng(0).uniform(1, 9, (5, 7)).astype(np.float16 if half else np.float32)
    values[0, 0], values[1, 2] = np.inf, 65504
    write_exr(tmp_path / "plain.exr", values, half)
    alpha = np.ones_like(values)
    for compression in ("ZIP", "PIZ"):
        header = {"compression": getattr(OpenEXR, f"{compression}_COMPRESSION"), "type": OpenEXR.scanlineimage}
        for channels in ({"V": values}, {"Z": values, "A": alpha}, {"RGBA": np.stack([values] * 3 + [alpha], -1)}):
            OpenEXR.File(header, channels).write(str(tmp_path / f"{compression}{''.join(channels)}.exr"))
    files = list(tmp_path.iterdir())
    assert len(files) == 7
    for file in files:
        assert np.array_equal(read_exr(file, (5, 7)), values.astype(np.float32))
    with pytest.raises(DataError, match=r"plain\.exr: 5x7 values, but the image has 7x5"):
        read_exr(tmp_path / "plain.exr", (7, 5))


def test_damaged_exr_files_give_one_kind_of_error(tmp_path):
    write_exr(tmp_path / "a.exr", np.ones((6, 8)))
    whole = (tmp_path / "a.exr").read_bytes()
    rng = np.random.default_rng(0)
    refused = []
    for trial in range(60):
        damaged = bytearray(whole[: rng.integers(len(whole))] if trial % 3 == 0 else whole)
        for position in rng.integers(0, max(len(damaged), 1), 3 * bool(trial % 3)):
            damaged[position] = rng.integers(256)
        (tmp_path / "a.exr").write_bytes(damaged)
        try:
            assert read_exr(tmp_path / "a.exr", (6, 8)).shape == (6, 8)
        except DataError as error:
            refused.append(str(error))
    assert len(refused) > 30
    assert all(text.startswith(str(tmp_path / "a.exr")) and "\n" not in text for text in refused)
