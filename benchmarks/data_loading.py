"""Images per second from files on disk to training batches.

    python benchmarks/data_loading.py data/srn_cars --category cars --split train

Times, in this order: reading the files, decoding them, the reader, the cached reader on random views, and the
whole DataLoader. Each is warmed up, then measured several times; medians and quartiles are printed.
"""

import argparse
import os
import platform
import statistics
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import torch
from rich.console import Console
from rich.table import Table

from nerfdiff.data.cache import CachedReader
from nerfdiff.data.datamodule import SceneDataModule
from nerfdiff.data.images import decode
from nerfdiff.data.scene import SceneReader
from nerfdiff.data.srn import SRNReader


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("root", type=Path, help="dataset in the SRN layout")
    parser.add_argument("--category", default="cars")
    parser.add_argument("--split", default="train")
    parser.add_argument("--image-size", type=int, help="resize to this side; default: as stored")
    parser.add_argument("--batch-size", type=int, default=32)
    parser.add_argument("--workers", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--images", type=int, default=1000, help="images per measurement")
    parser.add_argument("--repeats", type=int, default=5)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory(prefix="nerfdiff-benchmark-") as cache_dir:
        print_table(arguments, measure(arguments, cache_dir))


def measure(arguments: argparse.Namespace, cache_dir: str) -> list[tuple[str, list[float]]]:
    """(what, images per second of each repeat)."""
    make_reader = partial(SRNReader, category=arguments.category, near=0.8, far=1.8)
    reader = make_reader(root=arguments.root, split=arguments.split, image_size=arguments.image_size)
    files = [
        reader.folder / reader.scene_id(index) / "rgb" / f"{view}.png"
        for index in range(len(reader))
        for view in reader.view_names(index)
    ]
    files = list(np.random.default_rng(0).permutation(files)[: arguments.images])

    start = time.perf_counter()
    reader.fingerprint()
    print(f"fingerprint of {len(reader)} scenes: {time.perf_counter() - start:.3f} s")
    start = time.perf_counter()
    cached = CachedReader(reader, cache_dir, "benchmark")
    seconds = time.perf_counter() - start
    total = sum(len(cached.view_names(index)) for index in range(len(cached)))
    print(f"cache of {total} images: built in {seconds:.2f} s, {total / seconds:,.0f} images/s")

    def repeated(function: Callable[[], int]) -> list[float]:
        function()
        rates = []
        for _ in range(arguments.repeats):
            start = time.perf_counter()
            images = function()
            rates.append(images / (time.perf_counter() - start))
        return rates

    results = [
        ("read the files", repeated(lambda: sum(len(file.read_bytes()) > 0 for file in files))),
        ("decode the files", repeated(lambda: sum(decode(file).shape[2] == 3 for file in files))),
        ("reader, 2 views at a time", repeated(lambda: load_pairs(reader, arguments.images))),
        ("cached reader, 2 views at a time", repeated(lambda: load_pairs(cached, arguments.images))),
    ]
    steps = max(1, arguments.images // (2 * arguments.batch_size))
    for workers in arguments.workers:
        for cache in (False, True):
            data = SceneDataModule(
                name="benchmark",
                root=arguments.root,
                image_size=arguments.image_size,
                reader=make_reader,
                target_views=1,
                source_as_target=0.0,
                source_target_noise=0.0,
                background=1.0,
                batch_size=arguments.batch_size,
                val_source_view=0,
                val_scenes=1,
                val_targets=1,
                source_view=0,
                eval_scenes=None,
                eval_stride=1,
                num_workers=workers,
                cache=cache,
                cache_dir=cache_dir,
                seed=0,
                train_split=arguments.split,
                val_split=arguments.split,
            )
            data.setup("fit")
            rates = loader_rates(data, steps, arguments.repeats)
            results.append((f"DataLoader, {workers} workers, cache {'on' if cache else 'off'}", rates))
    return results


def load_pairs(reader: SceneReader, images: int) -> int:
    """Two random views of random scenes, as training asks for them."""
    generator = np.random.default_rng(0)
    for _ in range(images // 2):
        index = int(generator.integers(len(reader)))
        reader.load(index, generator.choice(len(reader.view_names(index)), 2, replace=False).tolist())
    return images // 2 * 2


def loader_rates(data: SceneDataModule, steps: int, repeats: int) -> list[float]:
    """Rates of consecutive stretches of one loader, the first of which (workers starting) is dropped."""
    batches = iter(data.train_loader(0, 1, 1, start_step=0, total_steps=steps * (repeats + 1)))
    rates = []
    for _ in range(repeats + 1):
        start = time.perf_counter()
        for _ in range(steps):
            next(batches).targets  # noqa: B018 (floats, as the model reads them)
        rates.append(2 * data.batch_size * steps / (time.perf_counter() - start))
    return rates[1:]


def print_table(arguments: argparse.Namespace, results: list[tuple[str, list[float]]]) -> None:
    device = torch.cuda.get_device_name() if torch.cuda.is_available() else "none"
    size = f"{arguments.image_size}²" if arguments.image_size else "stored size"
    table = Table(
        title=f"{arguments.root} {arguments.split}, {size}, batch {arguments.batch_size}\n"
        f"CPU: {cpu_name()}, {os.cpu_count()} cores; GPU: {device}; torch {torch.__version__}"
    )
    for column in ("", "images/s (median)", "quartiles", "ms/image"):
        table.add_column(column, justify="right" if column else "left", no_wrap=True)
    for name, rates in results:
        low, median, high = statistics.quantiles(rates, n=4) if len(rates) > 1 else rates * 3
        table.add_row(name, f"{median:,.0f}", f"{low:,.0f} to {high:,.0f}", f"{1000 / median:.3f}")
    Console().print(table)


def cpu_name() -> str:
    info = Path("/proc/cpuinfo")
    names = [line for line in info.read_text().splitlines() if "model name" in line] if info.exists() else []
    return names[0].split(": ")[1] if names else platform.processor() or "unknown"


if __name__ == "__main__":
    main()
