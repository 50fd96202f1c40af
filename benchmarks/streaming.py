"""Images a second and memory of a data loader that streams shards, and of the cache, on generated scenes.

    python benchmarks/streaming.py 1000 100000 --size 32 --folder /fast

Scenes are of noise, of a few views. Memory is what this process and its workers have of their own. Pages of mapped
files, which the system may drop, are told apart.
"""

import argparse
import itertools
import shutil
import tempfile
import time
from pathlib import Path

import numpy as np
import psutil
import torch

from nerfdiff.cameras import Cameras
from nerfdiff.data.datamodule import SceneDataModule
from nerfdiff.data.scene import Listing, Scene
from nerfdiff.data.streamed import make_shards


class Noise:
    """A reader of scenes that are computed, not stored."""

    nearest_view = False

    def __init__(self, scenes: int, views: int, size: int):
        self.scenes, self.views, self.size = scenes, views, size
        self.identity = f"noise {scenes} {views} {size}"

    def __len__(self) -> int:
        return self.scenes

    def fingerprint(self) -> str:
        return self.identity

    def scene_id(self, index: int) -> str:
        return f"scene{index:07d}"

    def view_names(self, index: int) -> tuple[str, ...]:
        return tuple(f"{view:06d}" for view in range(self.views))

    def listing(self, index: int) -> Listing:
        return Listing(np.zeros((self.views, 4, 4)), {})

    def load(self, index: int, views=None, truth: bool = False) -> Scene:
        positions = list(range(self.views) if views is None else views)
        noise = np.random.Philox(key=index).random_raw(self.views * 3 * self.size**2 // 8)
        pixels = torch.from_numpy(noise.view(np.uint8).reshape(self.views, 3, self.size, self.size).copy())
        c2w, K = torch.eye(4).repeat(len(positions), 1, 1), torch.eye(3).repeat(len(positions), 1, 1)
        names = tuple(self.view_names(index)[p] for p in positions)
        cameras = Cameras(c2w, K, self.size, self.size)
        return Scene(self.scene_id(index), names, pixels[positions], cameras, 0.8, 1.8)


def module(reader: Noise, folder: Path, shards: Path | None, workers: int) -> SceneDataModule:
    return SceneDataModule(
        name="noise", root=folder, image_size=None, background=1.0, reader=lambda **_: reader, train_scenes=None,
        train_source_view=None, train_source_views=None, target_views=1, source_as_target=0.1, source_target_noise=0.0,
        batch_size=32, val_source_view=0, val_scenes=1, val_targets=1, source_view=0, eval_scenes=None, eval_stride=1,
        num_workers=workers, cache=shards is None, cache_dir=folder / "cache", seed=0, about="", shards=shards,
    )  # fmt: skip


def memory() -> tuple[float, float]:
    """MB that are this process's and its workers' own, and MB of mapped files."""
    processes = [psutil.Process(), *psutil.Process().children(recursive=True)]
    full = [process.memory_full_info() for process in processes]
    mapped = [
        sum(region.pss for region in process.memory_maps() if region.path.startswith("/") and ".bin" in region.path)
        for process in processes
    ]
    return sum(of.uss for of in full) / 1e6, sum(mapped) / 1e6


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", type=int, nargs="+")
    parser.add_argument("--views", type=int, default=4)
    parser.add_argument("--size", type=int, default=32)
    parser.add_argument("--batches", type=int, default=300)
    parser.add_argument("--workers", type=int, default=0)
    parser.add_argument("--folder", help="of temporary files")
    arguments = parser.parse_args()
    for scenes in arguments.scenes:
        with tempfile.TemporaryDirectory(dir=arguments.folder) as place:
            folder, reader = Path(place), Noise(scenes, arguments.views, arguments.size)
            begun = time.process_time()
            make_shards(reader, folder / "shards" / "train", 64_000_000, 1)
            print(f"{scenes} scenes: shards written in {time.process_time() - begun:.0f} s of one core", flush=True)
            for kind, shards in (("shards", folder / "shards"), ("cache", None)):
                before, begun = memory(), time.process_time()
                made = module(reader, folder, shards, arguments.workers)
                made.train_reader = made.reader("train")
                if shards is None:
                    from nerfdiff.data.cache import CachedReader

                    made.train_reader = CachedReader(made.train_reader, folder / "cache", "noise")
                batches = iter(made.train_loader(0, 1, 1, 0, 10**6))
                next(batches)
                started = time.process_time() - begun
                begun, cpu = time.perf_counter(), time.process_time()
                for _ in itertools.islice(batches, arguments.batches):
                    pass
                images = 2 * 32 * arguments.batches
                own, mapped = memory()
                rates = (
                    images / (now() - then) for now, then in ((time.perf_counter, begun), (time.process_time, cpu))
                )
                print(
                    f"  {kind}: first batch after {started:.1f} s of one core, then {next(rates):.0f} images/s "
                    f"({next(rates):.0f} per second of one core), {own - before[0]:.0f} MB more, "
                    f"{mapped:.0f} MB mapped",
                    flush=True,
                )
                del batches, made
            shutil.rmtree(folder / "shards")


if __name__ == "__main__":
    main()
