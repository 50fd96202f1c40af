"""The cache equals its reader, follows the files, and survives other processes, kills and full disks."""

import multiprocessing
import os
import pickle
import resource
import shutil
import threading
from collections import namedtuple

import filelock
import pytest
import torch
from PIL import Image
from torch.utils.data import DataLoader

from data_fixtures import FAR, NEAR, write_scene, write_srn
from nerfdiff.data import cache as cache_module
from nerfdiff.data.batch import ViewBatch
from nerfdiff.data.cache import CachedReader
from nerfdiff.data.draws import Draws
from nerfdiff.data.readers.srn import SRNReader
from nerfdiff.data.views import TrainingViews
from nerfdiff.utils.errors import DataError


def reader_of(root, image_size=None) -> SRNReader:
    return SRNReader(root / "data", "cars", "train", NEAR, FAR, image_size)


def cached(root, image_size=None) -> CachedReader:
    return CachedReader(reader_of(root, image_size), root / "cache", "toy_train")


def caches(root) -> set[str]:
    return {path.name for path in (root / "cache").iterdir() if path.is_dir()}


@pytest.fixture
def root(tmp_path):
    write_srn(tmp_path / "data", truth=True)
    write_scene(tmp_path / "data/cars_train/scene3", views=7, seed=9)
    return tmp_path


def test_equals_the_reader(root):
    reader, copy = reader_of(root), cached(root)
    assert len(copy) == len(reader) == 4
    assert copy.fingerprint() == reader.fingerprint()
    for index in range(4):
        assert copy.scene_id(index) == reader.scene_id(index)
        assert copy.view_names(index) == reader.view_names(index)
        assert copy.listing(index).files == reader.listing(index).files
        for views in (None, [2, 0, 2], [-1]):
            here, there = copy.load(index, views), reader.load(index, views)
            assert (here.id, here.views, here.near, here.far) == (there.id, there.views, there.near, there.far)
            assert torch.equal(here.pixels, there.pixels)
            assert torch.equal(here.cameras.c2w, there.cameras.c2w) and torch.equal(here.cameras.K, there.cameras.K)
            assert (here.cameras.height, here.cameras.width) == (there.cameras.height, there.cameras.width)
    assert torch.equal(copy.load(0, [1], truth=True).depth, reader.load(0, [1], truth=True).depth)
    with pytest.raises(IndexError):
        copy.load(0, [5])


def test_is_not_decoded_again(root, monkeypatch):
    cached(root)
    monkeypatch.setattr(SRNReader, "load", lambda *_: pytest.fail("decoded again"))
    assert cached(root).load(3).pixels.shape[0] == 7


def test_is_rebuilt_when_files_change(root):
    cached(root)
    before = caches(root)
    shutil.copy(root / "data/cars_train/scene1/rgb/000000.png", root / "data/cars_train/scene0/rgb/000002.png")
    copy = cached(root)
    assert torch.equal(copy.load(0, [2]).pixels, copy.load(1, [0]).pixels)
    assert caches(root).isdisjoint(before) and len(caches(root)) == 1
    shutil.rmtree(root / "data/cars_train/scene1")
    assert len(cached(root)) == 3


def test_settings_have_caches_of_their_own(root):
    whole, small = cached(root), cached(root, image_size=[20, 28])
    assert whole.path != small.path and len(caches(root)) == 2
    assert cached(root).load(0).pixels.shape[-2:] == (40, 56)
    assert small.load(0).pixels.shape[-2:] == (20, 28)
    assert torch.equal(small.load(0).cameras.K, reader_of(root, [20, 28]).load(0).cameras.K)


def test_a_damaged_image_leaves_nothing_behind(root):
    (root / "data/cars_train/scene3/rgb/000004.png").write_bytes(b"\x89PNG")
    with pytest.raises(DataError, match=r"scene3/rgb/000004\.png"):
        cached(root)
    assert caches(root) == set()


def test_images_of_several_sizes_are_an_error(root):
    small = root / "small/cars_train"
    write_scene(small / "x", views=2)
    shutil.move(small / "x", root / "data/cars_train/scene9")
    for file in (root / "data/cars_train/scene9/rgb").iterdir():
        Image.new("RGB", (28, 20)).save(file)
    with pytest.raises(DataError, match=r"scene9 has images of 20x28, scene scene0 of 40x56; set data\.image_size"):
        cached(root)
    assert caches(root) == set()
    assert cached(root, image_size=16).load(4).pixels.shape == (2, 3, 16, 16)


def test_no_room_is_told_before_decoding(root, monkeypatch):
    usage = namedtuple("usage", "total used free")(10, 10, 1000)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage)
    with pytest.raises(DataError, match=r"takes 148 kB, and 1 kB are free.*data\.cache_dir.*data\.cache=false"):
        cached(root)
    assert caches(root) == set()


def test_a_disk_that_fills_up_leaves_nothing_behind(root):
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (64_000, limits[1]))  # the images take 148 kB
    try:
        with pytest.raises(DataError, match=r"toy_train-.*cannot be written.*File too large.*data\.cache_dir"):
            cached(root)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert caches(root) == set()
    assert len(cached(root)) == 4


def test_a_folder_that_cannot_be_written_is_named(root):
    (root / "cache").write_text("a file where the folder should be")
    with pytest.raises(DataError, match=r"cache/toy_train-.*cannot be written"):
        cached(root)


def test_leftovers_of_a_killed_build_are_replaced(root):
    path = cached(root).path
    partial = path.with_name(path.name + ".partial")
    path.rename(partial)
    (partial / "images.u8").write_bytes(b"half")
    assert torch.equal(cached(root).load(2).pixels, reader_of(root).load(2).pixels)
    assert caches(root) == {path.name}


def test_a_shortened_cache_is_refused(root):
    path = cached(root).path / "images.u8"
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(DataError, match=r"toy_train-.*damaged; delete this folder"):
        cached(root)


def test_a_cache_shortened_while_in_use_is_an_error(root):
    copy = cached(root)
    os.truncate(copy.path / "images.u8", 10_000)
    assert copy.load(0, [0]).pixels.shape[0] == 1
    with pytest.raises(DataError, match=r"toy_train-.*damaged; delete this folder"):
        copy.load(0, [1])


def test_another_builder_is_waited_for_and_its_cache_used(root, monkeypatch):
    path = cached(root).path
    path.rename(root / "elsewhere")
    monkeypatch.setattr(cache_module, "_write", lambda *_: pytest.fail("built twice"))
    lock = filelock.FileLock(root / "cache" / f"{path.name.rsplit('-', 1)[0]}.lock", thread_local=False)

    def finish() -> None:
        (root / "elsewhere").rename(path)
        lock.release()

    lock.acquire()
    threading.Timer(0.2, finish).start()
    assert len(cached(root)) == 4
    assert not lock.is_locked


def _build_and_digest(root, queue) -> None:
    copy = cached(root)
    queue.put([int(copy.load(index).pixels.long().sum()) for index in range(len(copy))])


def test_processes_may_build_at_once(root):
    context = multiprocessing.get_context("spawn")  # a fork of a process with OpenMP threads may hang
    queue = context.Queue()
    processes = [context.Process(target=_build_and_digest, args=(root, queue), daemon=True) for _ in range(3)]
    for process in processes:
        process.start()
    results = [queue.get(timeout=180) for _ in processes]
    for process in processes:
        process.join()
        assert process.exitcode == 0
    expected = [int(reader_of(root).load(index).pixels.long().sum()) for index in range(4)]
    assert results == [expected] * 3
    assert len(caches(root)) == 1


def test_pickles_without_its_open_file(root):
    copy = cached(root)
    copy.load(0)
    clone = pickle.loads(pickle.dumps(copy))
    assert clone._file is None and copy._file is not None
    assert torch.equal(clone.load(3).pixels, copy.load(3).pixels)


@pytest.mark.parametrize("method", ["fork", "spawn"])
def test_workers_read_the_same_batches(root, method):
    copy = cached(root)
    copy.load(0)
    dataset = TrainingViews(copy, Draws(seed=3, scenes=4, target_views=2, source_as_target=0.5))
    batches = [[4 * k + j for j in range(4)] for k in range(3)]
    options = {"batch_sampler": batches, "collate_fn": ViewBatch.collate}
    alone = list(DataLoader(dataset, **options))
    shared = list(DataLoader(dataset, **options, num_workers=1, multiprocessing_context=method))
    for a, b in zip(alone, shared, strict=True):
        assert torch.equal(a.target_pixels, b.target_pixels) and torch.equal(a.draws, b.draws)
        assert torch.equal(a.target_cameras.c2w, b.target_cameras.c2w) and a.scene_ids == b.scene_ids
