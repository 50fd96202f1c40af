"""Images per second from files on disk to training batches, of any dataset.

    python benchmarks/data_loading.py data=srn_cars data.root=data/srn_cars
    python benchmarks/data_loading.py data=clevr3d data.root=data/clevr3d data.image_size=[60,80] --workers 0 4

Times, in this order: reading the files (images, and the masks that are read with them), decoding them alone, the
reader, the cached reader on random views, and the whole DataLoader. Each is warmed up, then measured several times;
medians and quartiles are printed.
"""

import argparse
import os
import platform
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from unittest.mock import patch

import numpy as np
import torch
from hydra.utils import instantiate
from omegaconf import DictConfig
from rich.console import Console
from rich.table import Table

from nerfdiff.cli import load_config
from nerfdiff.data.cache import CachedReader
from nerfdiff.data.datamodule import SceneDataModule
from nerfdiff.data.formats import images
from nerfdiff.data.readers import masks
from nerfdiff.data.scene import SceneReader


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("overrides", nargs="+", help="of the training config: data=… data.root=…")
    parser.add_argument("--workers", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--images", type=int, default=1000, help="images per measurement")
    parser.add_argument("--repeats", type=int, default=5)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory(prefix="nerfdiff-benchmark-") as cache_dir:
        data = load_config("train", [*arguments.overrides, f"data.cache_dir={cache_dir}"]).data
        print_table(arguments, data, measure(arguments, data))


def measure(arguments: argparse.Namespace, data: DictConfig) -> list[tuple[str, list[float]]]:
    """(what, images per second of each repeat)."""
    reader = instantiate(data).reader("train")
    start = time.perf_counter()
    reader.fingerprint()
    print(f"fingerprint of {len(reader)} scenes: {time.perf_counter() - start:.3f} s")
    start = time.perf_counter()
    cached = CachedReader(reader, data.cache_dir, data.name)
    seconds = time.perf_counter() - start
    total = sum(len(cached.view_names(index)) for index in range(len(cached)))
    print(f"cache of {total} images: built in {seconds:.2f} s, {total / seconds:,.0f} images/s")
    files, mask_files = files_read(reader, arguments.images)

    def repeated(function: Callable[[], int]) -> list[float]:
        function()
        rates = []
        for _ in range(arguments.repeats):
            start = time.perf_counter()
            count = function()
            rates.append(count / (time.perf_counter() - start))
        return rates

    results = [
        ("read the files", repeated(lambda: read_alone(files, mask_files))),
        ("decode the files", repeated(lambda: decode_alone(files, mask_files))),
        ("reader, 2 views at a time", repeated(lambda: load_pairs(reader, arguments.images))),
        ("cached reader, 2 views at a time", repeated(lambda: load_pairs(cached, arguments.images))),
    ]
    steps = max(1, arguments.images // (views_per_draw(data) * data.batch_size))
    for workers in arguments.workers:
        for cache in (False, True):
            # a target that is its source would be an image that nobody decodes
            module = instantiate(data, num_workers=workers, cache=cache, source_as_target=0.0)
            module.setup("fit")
            rates = loader_rates(module, steps, arguments.repeats, views_per_draw(data))
            results.append((f"DataLoader, {workers} workers, cache {'on' if cache else 'off'}", rates))
    return results


def files_read(reader: SceneReader, count: int) -> tuple[list[Path], list[Path]]:
    """The images, and the masks beside them, that the reader decodes for so many views."""
    with (
        patch.object(images, "decode", wraps=images.decode) as decode,
        patch.object(masks, "open_image", wraps=masks.open_image) as open_mask,
    ):
        load_pairs(reader, count)
    return tuple([Path(call.args[0]) for call in calls.call_args_list] for calls in (decode, open_mask))


def read_alone(files: list[Path], mask_files: list[Path]) -> int:
    """Images read, with their masks."""
    return sum(len(file.read_bytes()) > 0 for file in [*files, *mask_files]) - len(mask_files)


def decode_alone(files: list[Path], mask_files: list[Path]) -> int:
    """Images decoded, with their masks."""
    for mask in mask_files:
        masks.read_mask(mask)
    return sum(images.decode(file).shape[2] == 3 for file in files)


def views_per_draw(data: DictConfig) -> int:
    """Images that a draw takes: its source and its targets."""
    return 1 + data.target_views


def load_pairs(reader: SceneReader, count: int) -> int:
    """Two random views of random scenes, as training asks for them."""
    generator = np.random.default_rng(0)
    for _ in range(count // 2):
        index = int(generator.integers(len(reader)))
        reader.load(index, generator.choice(len(reader.view_names(index)), 2, replace=False).tolist())
    return count // 2 * 2


def loader_rates(data: SceneDataModule, steps: int, repeats: int, views: int) -> list[float]:
    """Rates of consecutive stretches of one loader with so many views per draw.

    The first stretch, in which workers start, is dropped.
    """
    batches = iter(data.train_loader(0, 1, 1, start_step=0, total_steps=steps * (repeats + 1)))
    rates = []
    for _ in range(repeats + 1):
        start = time.perf_counter()
        for _ in range(steps):
            next(batches).targets  # noqa: B018 (floats, as the model reads them)
        rates.append(views * data.batch_size * steps / (time.perf_counter() - start))
    return rates[1:]


def print_table(arguments: argparse.Namespace, data: DictConfig, results: list[tuple[str, list[float]]]) -> None:
    device = torch.cuda.get_device_name() if torch.cuda.is_available() else "none"
    table = Table(
        title=f"{data.name}: {' '.join(arguments.overrides)}, batch {data.batch_size}\n"
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
