"""Seeded splits: right sizes, fixed for ever, kept in a file that is believed only while it is true."""

import json
import logging

import pytest

from nerfdiff.data.readers import split_file
from nerfdiff.data.readers.split_file import draw_split, seeded_order, stored_split
from nerfdiff.utils.errors import ConfigError, DataError

SIZES = {"train": 6743, "val": 396, "test": 794}


def ids(count: int) -> list[str]:
    return [f"B{k:05d}" for k in range(count)]


def sizes_of(splits) -> tuple[int, ...]:
    return tuple(len(members) for members in splits.values())


@pytest.fixture
def root(tmp_path):
    (tmp_path / "data").mkdir()
    return tmp_path / "data"


def split(root, names=None, seed: int = 0):
    return stored_split(root, root.parent / "cache", names or ids(40), SIZES, seed)


@pytest.mark.parametrize(
    ("count", "expected"),
    [
        (7933, (6743, 396, 794)),
        (7953, (6760, 397, 796)),  # 6760.0, 396.998, 795.999… of 7953
        (100, (85, 5, 10)),
        (8, (6, 1, 1)),
        (3, (1, 1, 1)),
        (2, (1, 1, 0)),
        (1, (1, 0, 0)),
    ],
)
def test_sizes_are_the_papers_or_in_its_proportions(count, expected):
    splits = draw_split(ids(count), SIZES, 0)
    assert list(splits) == ["train", "val", "test"]
    assert sizes_of(splits) == expected
    assert sorted(name for members in splits.values() for name in members) == ids(count)


def test_the_draw_depends_on_names_and_seed_alone():
    names = ids(200)
    assert draw_split(names, SIZES, 3) == draw_split(names[::-1], SIZES, 3)
    assert draw_split(names, SIZES, 3) != draw_split(names, SIZES, 4)
    # pinned: results of one year have to compare with those of another
    assert seeded_order(["a", "b", "c", "d", "e"], 0) == ["e", "b", "a", "c", "d"]


def test_the_draw_is_random():
    """Train holds its share of every stretch of names, within four standard deviations."""
    names = ids(7933)
    train = set(draw_split(names, SIZES, 0)["train"])
    for start in range(0, 7000, 1000):
        share = sum(name in train for name in names[start : start + 1000])
        assert abs(share - 850) < 4 * (1000 * 0.85 * 0.15) ** 0.5


@pytest.mark.parametrize("sizes", [{"train": 0, "test": 0}, {"train": -1, "test": 2}])
def test_sizes_that_are_none(sizes):
    with pytest.raises(ConfigError, match="split sizes"):
        draw_split(ids(4), sizes, 0)


def test_it_is_stored_beside_the_data_and_used_again(root, caplog, monkeypatch):
    caplog.set_level(logging.INFO)
    first = split(root)
    stored = json.loads((root / "split_seed0.json").read_text())
    assert (stored["splits"], stored["sha256"], stored["seed"], stored["sizes"]) == (*first, 0, SIZES)
    assert not (root.parent / "cache").exists()
    assert f"split {root}/split_seed0.json (drawn from seed 0): 34 train, 2 val, 4 test; sha256" in caplog.text
    monkeypatch.setattr(split_file, "draw_split", lambda *_: pytest.fail("drawn again"))
    caplog.clear()
    for _ in range(3):
        assert split(root) == first
    assert caplog.text.count("split_seed0.json (stored): 34 train") == 1


def test_seeds_have_files_of_their_own(root):
    assert split(root)[1] != split(root, seed=7)[1]
    assert {path.name for path in root.iterdir()} == {"split_seed0.json", "split_seed7.json"}


def test_where_the_data_cannot_be_written_it_is_stored_with_the_index(root, monkeypatch):
    write = split_file.write_text

    def refuse(path, text):
        if path.parent == root:
            raise DataError("read-only")
        write(path, text)

    monkeypatch.setattr(split_file, "write_text", refuse)
    first = split(root)
    (file,) = (root.parent / "cache").iterdir()
    assert file.name.startswith("split-") and file.name.endswith("_seed0.json")
    monkeypatch.setattr(split_file, "draw_split", lambda *_: pytest.fail("drawn again"))
    assert split(root) == first
    other = root.parent / "other"
    other.mkdir()
    with pytest.raises(pytest.fail.Exception, match="drawn again"):
        split(other)


def test_where_nothing_can_be_written_it_is_drawn_each_time(root, monkeypatch, caplog):
    def refuse(path, text):
        raise DataError(f"cannot write {path}")

    monkeypatch.setattr(split_file, "write_text", refuse)
    assert split(root) == split(root)
    assert "could not be stored: cannot write" in caplog.text


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda v: v["splits"]["train"].append(v["splits"]["test"].pop()), "sha256"),
        (lambda v: v["splits"].pop("val"), "sha256"),
        (lambda v: v.pop("splits"), "'splits'"),
        (lambda v: v["splits"].update(train="all"), "'train'"),
        (lambda v: v["splits"].update(train=[1, 2]), "'train'"),
        (lambda v: (v.pop("sha256"), v["splits"]["test"].append("B00001")), "listed twice: B00001"),
        (lambda v: (v.pop("sha256"), v["splits"]["test"].append("other")), "not there: other"),
    ],
)
def test_a_changed_file_is_refused(root, change, message):
    split(root)
    file = root / "split_seed0.json"
    values = json.loads(file.read_text())
    change(values)
    file.write_text(json.dumps(values))
    with pytest.raises(DataError, match=rf"split_seed0\.json.*{message}"):
        split(root)


def test_a_file_that_is_no_json(root):
    (root / "split_seed0.json").write_text("{'train")
    with pytest.raises(DataError, match=r"split_seed0\.json: expected a split"):
        split(root)


def test_other_objects_than_those_of_the_split_are_named(root):
    split(root)
    with pytest.raises(DataError, match=r"listed but not there: B00039; there but not listed: none; complete the data"):
        split(root, ids(39))
    with pytest.raises(DataError, match=r"there but not listed: B00040, B00041; complete"):
        split(root, ids(42))


def test_a_split_of_ones_own_may_leave_objects_out(root, caplog):
    caplog.set_level(logging.INFO)
    own = {"train": ids(9), "test": ["B00020", "B00011"]}
    (root / "split_seed0.json").write_text(json.dumps({"splits": own}))
    assert split(root)[0] == own
    assert "(stored, leaves out 29 objects that are there): 9 train, 2 test" in caplog.text
