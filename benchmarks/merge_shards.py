"""Measure what merging the shards of many scenes costs: seconds and memory, on shards as distill.py leaves them.

python benchmarks/merge_shards.py 1000000 --shards 100
"""

import argparse
import csv
import json
import resource
import tempfile
import time
from pathlib import Path

import numpy as np

from nerfdiff.cli import load_config
from nerfdiff.evaluation.measure import COSTS, SHARD
from nerfdiff.evaluation.merge import merge_shards
from nerfdiff.metrics.sets import SETS, FrechetDistance, write_statistics
from nerfdiff.metrics.summary import FACTS
from nerfdiff.metrics.table import named
from nerfdiff.results.row import ResultRow
from nerfdiff.utils.hashes import sha256_values
from nerfdiff.utils.shard import Shard

PARTS = ("seconds", "pieces", "encode", "render", "distill", "denoise", "fit", "guide")


def write(folder: Path, scenes: int, shards: int, features: int) -> None:
    """Shards whose numbers are drawn at random."""
    draw = np.random.default_rng(0)
    ids = [f"scene{n:08d}" for n in range(scenes)]
    identity = {"split_sha256": sha256_values(ids), "strategy": {"name": "ngd"}}
    metrics = named("image", "scene")
    sides = [np.asarray(draw.normal(size=(600, features)), np.float32) for _ in range(2)]
    distance = FrechetDistance()
    distance.update(*map(_tensor, sides))
    for number in range(1, shards + 1):
        shard = Shard(number, shards)
        mine = shard.share(ids)
        scores = folder / f"ngd-{number:08d}" / "scores" / "ngd"
        scores.mkdir(parents=True)
        values = draw.uniform(0.1, 0.9, (len(mine), len(metrics)))
        with open(scores / "per_scene.csv", "w", newline="") as file:
            table = csv.writer(file)
            table.writerow([*FACTS, *metrics])
            table.writerows(
                [scene, 25, "ok", "ok", 0, *(f"{v:.8g}" for v in line)]
                for scene, line in zip(mine, values.tolist(), strict=True)
            )
        seconds = draw.uniform(5, 15, (len(mine), len(PARTS))).tolist()
        with open(scores / COSTS, "w", newline="") as file:
            table = csv.writer(file)
            table.writerow(
                [*PARTS, "warm", "conditions", "peak_mem_bytes", "denoiser_calls", "field_queries", "virtual_views"]
                + ["status", "verdict"]
            )
            table.writerows([*line, True, "0123abcd", 10**9, 1600, 10**8, 50, "ok", "ok"] for line in seconds)
        write_statistics(scores / SETS, fid=FrechetDistance(), fd_st_vgg=distance)
        row = ResultRow(run_id="r/ngd-00000000", strategy="ngd", dataset="cars/test", shard=str(shard), timing_s=1e-4)
        facts = {"identity": identity | {"shard": str(shard)}, "cost_key": "0123abcd", "strategy": "ngd", "scoring": {}}
        row = {name: getattr(row, name) for name in row.__dataclass_fields__}
        (scores / SHARD).write_text(json.dumps(facts | {"scenes": list(mine), "row": row}))


def _tensor(array: np.ndarray):
    import torch

    return torch.from_numpy(array)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenes", type=int, nargs="+")
    parser.add_argument("--shards", type=int, default=100)
    parser.add_argument("--features", type=int, default=512, help="of the Fréchet distance")
    parser.add_argument("--folder", help="of temporary files")
    arguments = parser.parse_args()
    for scenes in arguments.scenes:
        with tempfile.TemporaryDirectory(dir=arguments.folder) as folder:
            write(Path(folder), scenes, arguments.shards, arguments.features)
            size = sum(path.stat().st_size for path in Path(folder).rglob("*") if path.is_file())
            before, start, cpu = peak(), time.perf_counter(), time.process_time()
            (row,) = merge_shards(load_config("merge_shards", [f"shards={folder}"]))
            print(
                f"{row.n_scenes} scenes of {arguments.shards} shards, {size / 1e6:.0f} MB: merged in "
                f"{time.process_time() - cpu:.1f} s of one core ({time.perf_counter() - start:.1f} s), "
                f"{peak() - before:.0f} MB more memory (before: {before:.0f} MB)",
                flush=True,
            )


def peak() -> float:
    """Megabytes."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3


if __name__ == "__main__":
    main()
