"""Shards of a dataset: the scenes, and the draws, of the reader that they were made from."""

import pickle
import shutil

import numpy as np
import pytest
import torch
from hydra.utils import instantiate

pytest.importorskip("litdata", reason="an extra: pip install -e '.[streaming]'")

from data_fixtures import FAR, NEAR, write_srn
from nerfdiff.cli import load_config
from nerfdiff.commands import make_shards as command
from nerfdiff.data.datamodule import SceneDataModule
from nerfdiff.data.readers.srn import SRNReader
from nerfdiff.data.streamed import StreamedReader, make_shards
from nerfdiff.utils.errors import ConfigError, DataError

SPLITS = {"train": 5, "val": 1}


def source(root, split="train", size=None):
    return SRNReader(root, "cars", split, NEAR, FAR, image_size=size)


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    root = tmp_path_factory.mktemp("data")
    write_srn(root, SPLITS, views=4)
    return root


@pytest.fixture(scope="module")
def shards(data, tmp_path_factory):
    """Several chunks, whose borders are within scenes."""
    folder = tmp_path_factory.mktemp("shards") / "cars"
    for split in SPLITS:
        assert make_shards(source(data, split), folder / split, chunk_bytes=25_000, threads=2)
    assert len(list((folder / "train" / "images").glob("*.bin"))) > 3
    return folder


def test_streamed_scenes_are_those_of_the_reader(data, shards):
    reader, streamed = source(data), StreamedReader(shards, "train")
    assert len(streamed) == 5 and streamed.identity == reader.identity
    assert streamed.fingerprint() == reader.fingerprint()
    copied = pickle.loads(pickle.dumps(streamed))
    for index in (4, 0, 2, 3, 1):
        assert streamed.scene_id(index) == reader.scene_id(index)
        assert streamed.view_names(index) == reader.view_names(index)
        for views in (None, [2, 0], [3]):
            for of in (streamed, copied):
                found, wanted = of.load(index, views), reader.load(index, views)
                assert torch.equal(found.pixels, wanted.pixels) and found.views == wanted.views
                assert torch.equal(found.cameras.c2w, wanted.cameras.c2w)
                assert torch.equal(found.cameras.K, wanted.cameras.K)
                assert (found.near, found.far) == (wanted.near, wanted.far)
        assert np.allclose(streamed.listing(index).c2w, reader.listing(index).c2w, atol=1e-6)


def module(data, *more) -> SceneDataModule:
    words = [f"data.root={data}", "data.batch_size=4", "data.cache=false", "data.num_workers=0", *more]
    made = instantiate(load_config("train", ["data=srn_cars", *words]).data)
    made.train_reader = made.reader("train")
    return made


def drawn(module, rank, world_size, start=0, workers=0):
    module.num_workers = workers
    return list(module.train_loader(rank, world_size, 1, start, 6))


def test_draws_are_the_same_from_shards_with_workers_and_ranks_and_after_going_on(data, shards):
    whole = drawn(module(data), 0, 1)
    streamed = module("nowhere", f"data.shards={shards}")
    for found in (drawn(streamed, 0, 1), drawn(streamed, 0, 1, workers=2)):
        assert len(found) == 6
        for one, other in zip(found, whole, strict=True):
            assert one.scene_ids == other.scene_ids and one.target_views == other.target_views
            assert torch.equal(one.source_pixels, other.source_pixels)
            assert torch.equal(one.target_pixels, other.target_pixels)
    for rank in (0, 1):
        for one, other in zip(drawn(streamed, rank, 2, start=3), whole[3:], strict=True):
            assert torch.equal(one.target_pixels, other.target_pixels[2 * rank : 2 * rank + 2])


def test_shards_are_made_once_and_not_of_other_files(data, shards, tmp_path):
    assert make_shards(source(data), shards / "train", 10**6, 1) is False
    other = tmp_path / "other"
    write_srn(other, {"train": 2}, views=4)
    with pytest.raises(DataError, match="other scenes, or of files that changed"):
        make_shards(source(other), shards / "train", 10**6, 1)


def test_a_split_that_is_missing_another_size_and_damage_are_named(data, shards, tmp_path):
    with pytest.raises(DataError, match=r"no shards of this split; src/make_shards\.py"):
        StreamedReader(shards, "test")
    with pytest.raises(ConfigError, match=r"holds images of 40x56, data\.image_size asks for 32x32"):
        StreamedReader(shards, "train", 32)
    copy = shutil.copytree(shards, tmp_path / "copy")
    chunk = sorted((copy / "train" / "images").glob("*.bin"))[1]
    content = bytearray(chunk.read_bytes())
    content[-1000] ^= 1
    chunk.write_bytes(content)
    reader = StreamedReader(copy, "train")
    with pytest.raises(DataError, match="is damaged"):
        [reader.load(index) for index in range(5)]


def test_a_scene_of_another_size_leaves_no_shards(data, tmp_path):
    class Odd(SRNReader):
        def load(self, index, views=None, truth=False):
            self.framing = source(data, size=[20, 28] if index else None).framing
            return super().load(index, views, truth)

    with pytest.raises(DataError, match=r"scene1 has images of 20x28, the first of 40x56; set data\.image_size"):
        make_shards(Odd(data, "cars", "train", NEAR, FAR), tmp_path / "out" / "train", 10**6, 1)
    assert list((tmp_path / "out").iterdir()) == []


def test_the_command_makes_the_splits_that_there_are(data, tmp_path, monkeypatch, capsys):
    words = [f"data.root={data}", f"out={tmp_path}", "splits=[train,val,test]", "data.image_size=16"]
    command.main.__wrapped__(load_config("make_shards", words))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["train", "val"]
    assert "left out" in capsys.readouterr().out
    assert StreamedReader(tmp_path, "val", 16).load(0).pixels.shape == (4, 3, 16, 16)
