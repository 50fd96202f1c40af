"""Files and folders that are whole or absent, also after a power cut: what is on the disk before what."""

import os
from pathlib import Path

import pytest

from nerfdiff.utils import files
from nerfdiff.utils.errors import BusyError, DataError
from nerfdiff.utils.files import atomic, held, publish, write_text


@pytest.fixture
def order(monkeypatch):
    """What was synced and moved, by its name, in order."""
    seen = []
    sync, replace, rename = files._sync, os.replace, Path.rename

    def note(kind, act):
        def noted(path, *more):
            seen.append((kind, Path(path).name if kind == "sync" else Path(more[0]).name))
            return act(path, *more)

        return noted

    monkeypatch.setattr(files, "_sync", note("sync", sync))
    monkeypatch.setattr(os, "replace", note("move", replace))
    monkeypatch.setattr(Path, "rename", note("move", rename))
    return seen


def test_a_file_is_on_the_disk_before_it_has_its_name_and_its_folder_after(order, tmp_path):
    write_text(tmp_path / "new" / "inner" / "a.txt", "x")
    temporary = f".a.{os.getpid()}.tmp.txt"
    assert order == [
        ("sync", tmp_path.name),  # which the new folder is in
        ("sync", "new"),
        ("sync", temporary),
        ("move", "a.txt"),
        ("sync", "inner"),
    ]


def test_a_folder_is_on_the_disk_with_all_that_is_in_it_before_it_has_its_name(order, tmp_path):
    partial = tmp_path / "partial"
    (partial / "rgb").mkdir(parents=True)
    (partial / "rgb" / "0.png").write_text("x")
    (partial / "scene.json").write_text("y")
    publish(partial, tmp_path / "scene")
    moved = order.index(("move", "scene"))
    assert {name for _, name in order[:moved]} == {"0.png", "rgb", "scene.json", "partial"}
    assert order[moved + 1 :] == [("sync", tmp_path.name)]


@pytest.mark.parametrize("links", [True, False])
def test_the_file_before_is_kept(links, tmp_path, monkeypatch):
    def no_links(*paths):
        raise PermissionError("this disk has no links")

    if not links:
        monkeypatch.setattr(os, "link", no_links)
    last, previous = tmp_path / "last", tmp_path / "previous"
    for number in range(3):
        with atomic(last, former=previous) as temporary:
            temporary.write_text(str(number))
    assert (last.read_text(), previous.read_text()) == ("2", "1")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["last", "previous"]


def test_a_file_that_cannot_be_synced_takes_no_name(tmp_path, monkeypatch):
    """A full disk may only be noticed when what was written is to be on it."""
    write_text(tmp_path / "a", "before")

    def full(file):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(DataError, match="No space left"):
        write_text(tmp_path / "a", "after")
    assert (tmp_path / "a").read_text() == "before" and len(list(tmp_path.iterdir())) == 1


def test_a_folder_is_held_by_one(tmp_path):
    with (
        held(tmp_path / "run"),
        pytest.raises(BusyError, match=f"process {os.getpid()} on {os.uname().nodename} is working"),
        held(tmp_path / "run"),
    ):
        pass
    with held(tmp_path / "run"):
        assert (tmp_path / "run" / ".owner").exists()
    assert not (tmp_path / "run" / ".owner").exists()
