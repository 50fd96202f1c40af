"""An index is built once, follows its stamp, and never stands in the way of a run."""

import os

import pytest

from nerfdiff.data.readers.index import cached_index, folder_stamp, index_name
from nerfdiff.utils.errors import DataError


class Scan:
    """Counts how often it is asked."""

    def __init__(self, found):
        self.found, self.times = found, 0

    def __call__(self):
        self.times += 1
        return self.found


def test_is_built_once(tmp_path):
    scan = Scan({"items": ["a", "é"], "count": 2, "pair": (1, 2)})
    for _ in range(3):
        # alike whether it was just built or read again
        assert cached_index(tmp_path / "deep/cache", "x", "1", scan) == {
            "items": ["a", "é"],
            "count": 2,
            "pair": [1, 2],
        }
    assert scan.times == 1
    assert [path.name for path in (tmp_path / "deep/cache").iterdir()] == ["x.index.json"]


def test_another_stamp_or_name_builds_anew(tmp_path):
    scan = Scan([1])
    for name, stamp in (("x", "1"), ("x", "2"), ("y", "2"), ("x", "2"), ("x", "1")):
        cached_index(tmp_path, name, stamp, scan)
    assert scan.times == 4


def test_an_index_that_no_longer_holds_is_built_anew(tmp_path):
    scan = Scan({"time": 3})
    for time, expected in ((3, 1), (3, 1), (4, 2)):
        cached_index(tmp_path, "x", "1", scan, fresh=lambda index, time=time: index["time"] == time)
        assert scan.times == expected


@pytest.mark.parametrize("damage", ["", "{", '{"stamp": "1"}', "[1]", "7", '{"stamp": "1", "index": 5}', "\x00\xff"])
def test_a_damaged_file_is_replaced(tmp_path, damage, caplog):
    scan = Scan({"time": 3})
    cached_index(tmp_path, "x", "1", scan)
    (tmp_path / "x.index.json").write_text(damage, encoding="latin-1")
    for _ in range(2):
        assert cached_index(tmp_path, "x", "1", scan, fresh=lambda index: index["time"] == 3) == {"time": 3}
    assert scan.times == 2
    assert "x.index.json is damaged" in caplog.text


def test_a_folder_that_cannot_be_written_costs_time_only(tmp_path, caplog):
    (tmp_path / "cache").write_text("a file where the folder should be")
    scan = Scan([1, 2])
    for _ in range(2):
        assert cached_index(tmp_path / "cache", "x", "1", scan) == [1, 2]
    assert scan.times == 2
    assert "every start scans the dataset; set data.cache_dir" in caplog.text


def test_what_fails_is_not_stored(tmp_path):
    def fail():
        raise DataError("bad")

    with pytest.raises(DataError, match="bad"):
        cached_index(tmp_path, "x", "1", fail)
    assert list(tmp_path.iterdir()) == []


def test_names_tell_roots_apart(tmp_path, monkeypatch):
    (tmp_path / "a").mkdir()
    monkeypatch.chdir(tmp_path)
    assert index_name("abo", "a") == index_name("abo", tmp_path / "a") != index_name("abo", tmp_path / "b")
    assert index_name("abo", "a") != index_name("other", "a")


def test_a_stamp_follows_what_lies_in_folders(tmp_path):
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        os.utime(tmp_path / name, ns=(5, 5))
    paths = [tmp_path / "a", tmp_path / "b", tmp_path / "c"]
    stamps = [folder_stamp(paths), folder_stamp(paths[::-1]), folder_stamp(paths[:2])]
    (tmp_path / "b/new").touch()
    stamps.append(folder_stamp(paths))
    (tmp_path / "c").touch()
    stamps.append(folder_stamp(paths))
    assert len(set(stamps)) == 5
    assert folder_stamp(paths) == stamps[-1]
