"""Lightning's view of a dataset: counted training draws, and held-out scenes to validate and test on."""

import logging
from collections.abc import Callable, Sequence
from dataclasses import asdict
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from lightning import LightningDataModule
from torch.utils.data import DataLoader

from nerfdiff.data.batch import ViewBatch
from nerfdiff.data.cache import CachedReader
from nerfdiff.data.draws import Draws, DrawSampler
from nerfdiff.data.scene import MissingSplit, SceneReader
from nerfdiff.data.streamed import StreamedReader
from nerfdiff.data.views import EvaluationScenes, TrainingViews
from nerfdiff.stopping import ignore_signals
from nerfdiff.utils.errors import ConfigError
from nerfdiff.utils.shard import Shard
from nerfdiff.utils.spread import spread

log = logging.getLogger(__name__)


class SceneDataModule(LightningDataModule):
    """Training draws (source view, target views) and evaluation scenes (source view, the other views).

    Every batch is a `ViewBatch`. The trainer decides the rest: one training epoch is the whole run of
    `max_steps` optimizer steps; a batch holds `batch_size` / (world size · `accumulate_grad_batches`) draws;
    and a run that resumes at step s goes on with the draws that follow. Sampling is spread over ranks here,
    so the trainer needs `use_distributed_sampler=False`.

    Args:
        name: the dataset's name, for results and caches.
        root: the dataset's folder.
        image_size: side in pixels, or (height, width), to which all images are resized (None: as stored).
        background: grey level behind everything, for the renderer; None where the farthest sample is opaque.
        reader: makes the reader of a split, as `reader(root=..., split=..., image_size=...)`.
        train_scenes: how many scenes to train on, spread evenly over the split (None: all).
        train_source_view: number of the view that every draw takes as its source (None: any view).
        train_source_views: sources are among so many first views of a scene (None: any view), so that a frozen field
            has fewer renderings to keep.
        target_views: T, target views per training draw.
        source_as_target: probability that a draw's first target is its source view.
        source_target_noise: variance of the noise on the camera position of such a target, in squared scene units
            (paper, appendix: 0.3 on Clevr3D).
        batch_size: draws per optimizer step, over all ranks and accumulated batches.
        val_source_view, source_view: number of the input view in validation and in the test.
        val_scenes, val_targets: how many held-out scenes, and targets of each, one validation looks at.
        eval_scenes: how many scenes the test looks at (None: all).
        eval_stride: the test takes every `eval_stride`-th of a scene's other views as a target.
        num_workers: processes that load training and test batches.
        cache, cache_dir: whether training images are decoded once into one file, and where.
        seed: of the draws.
        shards: folder or URL of `make_shards`, from which all splits are streamed instead of read from `root` (None).
        about: words on the data for whoever uses a model trained on it, as the elevations its cameras have.
        train_split, val_split, test_split: names of the dataset's splits. Where the one for validation is
            not there, training goes on without validation.

    Raises:
        ConfigError: values that no run can have.
    """

    def __init__(
        self,
        name: str,
        root: str | Path,
        image_size: int | Sequence[int] | None,
        background: float | None,
        reader: Callable[..., SceneReader],
        train_scenes: int | None,
        train_source_view: int | None,
        train_source_views: int | None,
        target_views: int,
        source_as_target: float,
        source_target_noise: float,
        batch_size: int,
        val_source_view: int,
        val_scenes: int,
        val_targets: int,
        source_view: int,
        eval_scenes: int | None,
        eval_stride: int,
        num_workers: int,
        cache: bool,
        cache_dir: str | Path,
        seed: int,
        about: str,
        shards: str | None = None,
        train_split: str = "train",
        val_split: str = "val",
        test_split: str = "test",
    ):
        super().__init__()
        self.allow_zero_length_dataloader_with_multiple_devices = True  # fewer test scenes than ranks
        at_least_one = {
            "target_views": target_views,
            "batch_size": batch_size,
            "val_scenes": val_scenes,
            "val_targets": val_targets,
            "train_scenes": 1 if train_scenes is None else train_scenes,
            "train_source_views": 1 if train_source_views is None else train_source_views,
            "eval_scenes": 1 if eval_scenes is None else eval_scenes,
            "eval_stride": eval_stride,
        }
        for key, value in at_least_one.items():
            if value < 1:
                raise ConfigError(f"data.{key}={value} must be at least 1")
        if not 0 <= source_as_target <= 1:
            raise ConfigError(f"data.source_as_target={source_as_target} is a probability, from 0 to 1")
        if source_target_noise < 0:
            raise ConfigError(f"data.source_target_noise={source_target_noise} is a variance, of at least 0")
        if background is not None and not 0 <= background <= 1:
            raise ConfigError(f"data.background={background} is a grey level from 0 to 1, or null")
        if not 0 <= seed < 2**64:
            raise ConfigError(f"data.seed={seed} must be from 0 to 2^64 - 1")
        self.name, self.make_reader = name, reader
        if shards is not None:
            self.make_reader = lambda root, split, image_size: StreamedReader(shards, split, image_size)
        self.root, self.image_size, self.background = root, image_size, background
        self.train_scenes, self.train_source_view = train_scenes, train_source_view
        self.train_source_views = train_source_views
        self.target_views, self.source_as_target = target_views, source_as_target
        self.source_target_noise = source_target_noise
        self.batch_size, self.num_workers, self.seed = batch_size, num_workers, seed
        self.val_source_view, self.val_scenes, self.val_targets = val_source_view, val_scenes, val_targets
        self.source_view, self.eval_scenes, self.eval_stride = source_view, eval_scenes, eval_stride
        self.cache, self.cache_dir = cache and shards is None, cache_dir
        self.about = about
        self.splits = {"train": train_split, "val": val_split, "test": test_split}
        self.train_reader: SceneReader | None = None
        self.val_set: EvaluationScenes | None = None
        self.test_set: EvaluationScenes | None = None
        self.shard: Shard | None = None  # of the test scenes; None: all

    @cached_property
    def _trained_on(self) -> dict[str, str]:
        reader = self.reader("train")
        return {"root": str(Path(self.root).resolve()), "reader": reader.identity, "files": reader.fingerprint()}

    def state_dict(self) -> dict[str, str]:
        """Identify the training data for checkpoints: the reader's identity, and its files' fingerprint."""
        return self._trained_on

    def reader(self, stage: str) -> SceneReader:
        """The reader of the files of the split that "train", "val" or "test" stands for.

        Raises:
            MissingSplit, DataError: as the reader's.
        """
        return self.make_reader(root=self.root, split=self.splits[stage], image_size=self.image_size)

    @property
    def trained_scenes(self) -> int:
        """Number of scenes a run draws from."""
        return len(spread(len(self.train_reader), self.train_scenes))

    def setup(self, stage: str) -> None:
        if stage == "fit":
            _ = self._trained_on  # of the files as they are now, not at the first checkpoint
            self.train_reader = self.reader("train")
            if self.cache:
                name = f"{self.name}_{self.splits['train']}"
                self.train_reader = CachedReader(self.train_reader, self.cache_dir, name)
            try:
                self.val_set = self._validation_scenes()
            except MissingSplit as error:
                self.val_set = None
                if self.trainer is not None:
                    self.trainer.limit_val_batches = 0  # Lightning's way of having no validation
                if self.trainer is None or self.trainer.is_global_zero:
                    log.warning("training without validation: %s (data.val_split names another split)", error)
        elif stage == "validate":
            self.val_set = self._validation_scenes()
        else:
            self.test_set = EvaluationScenes(
                self.reader("test"),
                self.source_view,
                scenes=self.eval_scenes,
                stride=self.eval_stride,
                shard=self.shard,
            )

    def train_dataloader(self) -> DataLoader:
        trainer = self.trainer
        if trainer.max_steps < 1:
            raise ConfigError(
                f"trainer.max_steps={trainer.max_steps}: the data module deals out the draws of a run of so many "
                "optimizer steps; set it to 1 or more"
            )
        return self.train_loader(
            rank=trainer.global_rank,
            world_size=trainer.world_size,
            accumulate=trainer.accumulate_grad_batches,
            start_step=trainer.global_step,
            total_steps=trainer.max_steps,
        )

    def train_loader(
        self, rank: int, world_size: int, accumulate: int, start_step: int, total_steps: int
    ) -> "TrainingLoader":
        """One rank's batches from `start_step` on; the length is that of the whole run.

        Raises:
            ConfigError: `batch_size` cannot be shared out equally.
        """
        micro_batch_size, rest = divmod(self.batch_size, world_size * accumulate)
        if rest or not micro_batch_size:
            raise ConfigError(
                f"data.batch_size={self.batch_size} is not divisible by {world_size} processes x "
                f"trainer.accumulate_grad_batches={accumulate}"
            )
        scenes = len(spread(len(self.train_reader), self.train_scenes))
        draws = Draws(
            self.seed,
            scenes,
            self.target_views,
            self.source_as_target,
            self.source_target_noise,
            self.train_source_views,
        )
        sampler = DrawSampler(
            self.batch_size,
            micro_batch_size,
            rank,
            world_size,
            start_step=start_step,
            total_steps=total_steps,
        )
        return TrainingLoader(
            TrainingViews(self.train_reader, draws, self.train_source_view),
            batch_sampler=sampler,
            num_workers=self.num_workers,
            **_common_options(),
        )

    def val_dataloader(self) -> DataLoader | list:
        """Every rank sees all validation scenes, so that ranks never wait for each other's batches."""
        if self.val_set is None:
            return []
        return DataLoader(self.val_set, **_common_options())

    def test_dataloader(self) -> DataLoader:
        """Each rank tests its own share of the scenes."""
        rank, world_size = (self.trainer.global_rank, self.trainer.world_size) if self.trainer else (0, 1)
        return self.scenes(range(rank, len(self.test_set), world_size))

    def scenes(self, positions: Sequence[int]) -> DataLoader:
        """Batches of one test scene each, of these positions in the test set."""
        return DataLoader(self.test_set, sampler=positions, num_workers=self.num_workers, **_common_options())

    def _validation_scenes(self) -> EvaluationScenes:
        reader = self.reader("val")
        return EvaluationScenes(reader, self.val_source_view, scenes=self.val_scenes, targets=self.val_targets)


def _common_options() -> dict[str, Any]:
    return {
        "collate_fn": ViewBatch.collate,
        "pin_memory": torch.cuda.is_available(),
        "worker_init_fn": ignore_signals,  # a step that is to be finished needs its data
    }


class TrainingLoader(DataLoader):
    """A loader with a state, which is how Lightning knows that it resumes where it stopped.

    Where it stopped is the trainer's step. The state holds what the draws depend on beside, to tell when a
    resumed run is not the run that was stopped.
    """

    def state_dict(self) -> dict[str, int | float]:
        return {**asdict(self.dataset.draws), "batch_size": self.batch_sampler.batch_size}

    def load_state_dict(self, state: dict[str, int | float]) -> None:
        now = self.state_dict()
        changed = [f"{key} {state.get(key)} -> {now[key]}" for key in now if state.get(key) != now[key]]
        if changed:
            log.warning("the run resumes with other training draws than it began with: %s", ", ".join(changed))
