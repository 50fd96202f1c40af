"""From files through config, cache, loader and trainer to batches."""

from functools import partial

import numpy as np
import pytest
import torch
from hydra.utils import instantiate
from lightning import LightningModule, Trainer

from data_fixtures import COLOURS, FAR, NEAR, POINTS, project, visible, write_srn
from nerfdiff.cli import load_config
from nerfdiff.data.batch import ViewBatch
from nerfdiff.data.cache import CachedReader
from nerfdiff.data.datamodule import SceneDataModule
from nerfdiff.data.readers.srn import SRNReader
from nerfdiff.data.scene import MissingSplit
from nerfdiff.utils.errors import ConfigError, DataError


def datamodule(root, **changes) -> SceneDataModule:
    settings = {
        "name": "toy",
        "root": root / "data",
        "image_size": None,
        "reader": partial(SRNReader, category="cars", near=NEAR, far=FAR),
        "train_scenes": None,
        "train_source_view": None,
        "target_views": 2,
        "source_as_target": 0.2,
        "source_target_noise": 0.0,
        "background": 1.0,
        "batch_size": 6,
        "val_source_view": 1,
        "val_scenes": 8,
        "val_targets": 2,
        "source_view": 1,
        "eval_scenes": None,
        "eval_stride": 1,
        "num_workers": 0,
        "cache": True,
        "cache_dir": root / "cache",
        "seed": 3,
        "train_source_views": None,
        "about": "made by a test",
    }
    return SceneDataModule(**settings | changes)


class Recorder(LightningModule):
    """Trains one number, and notes the draws and scenes it was shown."""

    def __init__(self):
        super().__init__()
        self.weight = torch.nn.Parameter(torch.zeros(()))
        self.trained: list[list[int]] = []
        self.validated: list[tuple[str, tuple[str, ...]]] = []
        self.tested: list[tuple[str, int]] = []

    def training_step(self, batch: ViewBatch, batch_idx: int):
        self.trained.append(batch.draws.tolist())
        return self.weight * batch.source.mean()

    def validation_step(self, batch: ViewBatch, batch_idx: int):
        self.validated.append((batch.scene_ids[0], batch.target_views[0]))

    def test_step(self, batch: ViewBatch, batch_idx: int):
        self.tested.append((batch.scene_ids[0], batch.targets.shape[1]))

    def configure_optimizers(self):
        return torch.optim.SGD(self.parameters(), lr=0.1)


def trainer(root, max_steps: int, **options) -> Trainer:
    settings = {
        "accelerator": "cpu",
        "max_steps": max_steps,
        "max_epochs": -1,
        "logger": False,
        "enable_progress_bar": False,
        "enable_model_summary": False,
        "enable_checkpointing": False,
        "use_distributed_sampler": False,
        "num_sanity_val_steps": 0,
        "default_root_dir": root,
    }
    return Trainer(**settings | options)


@pytest.fixture
def root(tmp_path):
    write_srn(tmp_path / "data")
    return tmp_path


@pytest.mark.parametrize("cache", [True, False])
def test_known_points_are_found_in_every_target_of_a_batch(tmp_path, cache):
    """The whole path keeps one axis convention: points in the source camera's space project to their colours."""
    poses = write_srn(tmp_path / "data", views=6)
    data = datamodule(tmp_path, cache=cache)
    data.setup("fit")
    assert isinstance(data.train_reader, CachedReader) == cache
    checked = 0
    for batch in data.train_loader(rank=0, world_size=1, accumulate=1, start_step=0, total_steps=4):
        for b, scene in enumerate(batch.scene_ids):
            source = np.linalg.inv(poses[f"train/{scene}"][int(batch.source_views[b])])
            points = torch.from_numpy(POINTS @ source[:3, :3].T + source[:3, 3]).float()
            for cameras, images, names in (
                (batch.source_cameras[b][None], batch.source[b][None], (batch.source_views[b],)),
                (batch.target_cameras[b], batch.targets[b], batch.target_views[b]),
            ):
                pixels, depth = cameras.project(points)
                for v, name in enumerate(names):
                    pose = poses[f"train/{scene}"][int(name)]
                    np.testing.assert_allclose(pixels[v], project(pose)[:, :2], atol=1e-3)
                    np.testing.assert_allclose(depth[v], project(pose)[:, 2], atol=1e-5)
                    for k in visible(pose):
                        column, row = pixels[v, k].floor().long()
                        assert (images[v, :, row, column] * 255).round().tolist() == COLOURS[k].tolist()
                        checked += 1
    assert checked > 150


def test_trains_on_every_draw_once_and_resumes_at_the_next(root, caplog):
    whole = Recorder()
    trainer(root, 7).fit(whole, datamodule(root))
    assert whole.trained == [list(range(6 * step, 6 * step + 6)) for step in range(7)]

    first, second = Recorder(), Recorder()
    stopped = trainer(root, 3)
    stopped.fit(first, datamodule(root))
    stopped.save_checkpoint(root / "last.ckpt")
    resumed = trainer(root, 7)
    resumed.fit(second, datamodule(root), ckpt_path=root / "last.ckpt", weights_only=True)
    assert first.trained + second.trained == whole.trained
    assert resumed.global_step == 7
    assert "other training draws" not in caplog.text
    assert second.weight.item() == whole.weight.item() != 0


def test_resuming_mid_run_gives_no_false_alarm(root, recwarn):
    class StopAtThree(Recorder):
        def on_train_batch_end(self, *_):
            if self.trainer.global_step == 3:
                self.trainer.save_checkpoint(root / "mid.ckpt")
                self.trainer.should_stop = True

    trainer(root, 7).fit(StopAtThree(), datamodule(root))
    resumed = Recorder()
    trainer(root, 7).fit(resumed, datamodule(root), ckpt_path=root / "mid.ckpt", weights_only=True)
    assert resumed.trained == [list(range(6 * step, 6 * step + 6)) for step in range(3, 7)]
    assert not [str(w.message) for w in recwarn if "not resumable" in str(w.message)]


def test_resuming_with_other_draws_is_told(root, caplog):
    stopped = trainer(root, 2)
    stopped.fit(Recorder(), datamodule(root))
    stopped.save_checkpoint(root / "last.ckpt")
    trainer(root, 3).fit(Recorder(), datamodule(root, seed=4), ckpt_path=root / "last.ckpt", weights_only=True)
    assert "other training draws than it began with: seed 3 -> 4" in caplog.text


@pytest.mark.parametrize("accumulate", [2, 3])
def test_accumulation_splits_the_same_step(root, accumulate):
    module = Recorder()
    trainer(root, 4, accumulate_grad_batches=accumulate).fit(module, datamodule(root))
    assert [len(draws) for draws in module.trained] == [6 // accumulate] * (4 * accumulate)
    assert [draw for draws in module.trained for draw in draws] == list(range(24))


def test_ranks_share_out_one_global_batch(root):
    data = datamodule(root)
    data.setup("fit")
    alone = list(data.train_loader(rank=0, world_size=1, accumulate=1, start_step=0, total_steps=3))
    ranks = [list(data.train_loader(rank, world_size=2, accumulate=1, start_step=0, total_steps=3)) for rank in (0, 1)]
    for step in range(3):
        halves = [rank[step] for rank in ranks]
        for name in ("draws", "source_pixels", "target_pixels"):
            assert torch.equal(torch.cat([getattr(half, name) for half in halves]), getattr(alone[step], name))
        assert halves[0].scene_ids + halves[1].scene_ids == alone[step].scene_ids


def test_workers_do_not_change_batches(root):
    batches = []
    for num_workers in (0, 2):
        data = datamodule(root, num_workers=num_workers)
        data.setup("fit")
        batches.append(list(data.train_loader(rank=0, world_size=1, accumulate=1, start_step=1, total_steps=4)))
    for alone, shared in zip(*batches, strict=True):
        assert torch.equal(alone.draws, shared.draws)
        assert torch.equal(alone.source_pixels, shared.source_pixels)
        assert torch.equal(alone.target_pixels, shared.target_pixels)


def test_validates_on_fixed_scenes_with_few_targets(root):
    module = Recorder()
    trainer(root, 4, val_check_interval=2).fit(module, datamodule(root))
    assert module.validated == [("scene0", ("000002", "000004"))] * 2


def test_trains_without_a_validation_split(tmp_path, caplog, recwarn):
    write_srn(tmp_path / "data", {"train": 2, "test": 1})
    module = Recorder()
    trainer(tmp_path, 3, val_check_interval=1).fit(module, datamodule(tmp_path))
    assert len(module.trained) == 3 and module.validated == []
    assert not [str(w.message) for w in recwarn if "length" in str(w.message).lower()]
    (message,) = [record.message for record in caplog.records if "without validation" in record.message]
    assert "no val split of SRN cars" in message and "data.val_split" in message
    trainer(tmp_path, 3, val_check_interval=3).fit(module, datamodule(tmp_path, val_split="test"))
    assert [scene for scene, _ in module.validated] == ["scene0"]
    with pytest.raises(MissingSplit):
        datamodule(tmp_path).setup("validate")


def test_a_damaged_validation_split_is_no_missing_one(root):
    (root / "data/cars_val/scene0/pose/000001.txt").unlink()
    with pytest.raises(DataError, match="images without a pose: 000001"):
        datamodule(root).setup("fit")


def test_tests_whole_scenes_and_caches_nothing(root):
    module = Recorder()
    trainer(root, 1).test(module, datamodule(root), verbose=False)
    assert module.tested == [("scene0", 4), ("scene1", 4)]
    trainer(root, 1).test(module, datamodule(root, eval_scenes=1, eval_stride=3), verbose=False)
    assert module.tested[2:] == [("scene1", 2)]
    assert not (root / "cache").exists()


def test_test_scenes_are_shared_out_among_ranks(root, monkeypatch):
    data = datamodule(root)
    data.setup("test")
    seen = []
    for rank in range(3):
        data.trainer = type("Ranks", (), {"global_rank": rank, "world_size": 3})()
        seen.append([batch.scene_ids[0] for batch in data.test_dataloader()])
    assert seen == [["scene0"], ["scene1"], []]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"batch_size": 0}, r"data\.batch_size=0"),
        ({"target_views": 0}, r"data\.target_views=0"),
        ({"eval_stride": 0}, r"data\.eval_stride=0"),
        ({"train_source_views": 0}, r"data\.train_source_views=0"),
        ({"eval_scenes": 0}, r"data\.eval_scenes=0"),
        ({"source_as_target": 1.5}, r"data\.source_as_target=1\.5"),
        ({"seed": -1}, r"data\.seed=-1"),
    ],
)
def test_impossible_settings(root, changes, message):
    with pytest.raises(ConfigError, match=message):
        datamodule(root, **changes)


def test_settings_the_trainer_cannot_meet(root):
    with pytest.raises(ConfigError, match=r"data\.batch_size=6 is not divisible by 1 processes x .*=4"):
        trainer(root, 4, accumulate_grad_batches=4).fit(Recorder(), datamodule(root))
    with pytest.raises(ConfigError, match=r"trainer\.max_steps=-1"):
        trainer(root, -1).fit(Recorder(), datamodule(root))


@pytest.mark.parametrize(
    ("name", "category", "near", "far"), [("srn_cars", "cars", 0.8, 1.8), ("srn_chairs", "chairs", 1.25, 2.75)]
)
def test_shipped_configs_make_working_data(tmp_path, name, category, near, far):
    write_srn(tmp_path / "data", views=66, scenes={"train": 1, "test": 1}, category=category)
    folders = [f"data.root={tmp_path / 'data'}", f"data.cache_dir={tmp_path / 'cache'}"]
    config = load_config("train", [f"data={name}", "seed=2", "data.image_size=[32,32]", *folders])
    data = instantiate(config.data)
    assert (data.name, data.seed, data.batch_size, data.splits["val"]) == (name, 2, 32, "val")
    data.setup("fit")
    data.setup("test")
    (batch,) = data.test_dataloader()
    assert batch.source_views == ("000064",) and batch.targets.shape == (1, 65, 3, 32, 32)
    assert (batch.near.item(), batch.far.item()) == (pytest.approx(near), pytest.approx(far))
