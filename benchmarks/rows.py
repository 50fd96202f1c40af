"""Time to read many rows of results, and to chart them, on one core.

python benchmarks/rows.py 10000 100000 [--chart]
"""

import argparse
import json
import resource
import sys
import tempfile
import time
from dataclasses import asdict
from pathlib import Path

from nerfdiff.results.row import ResultRow, read_rows


def write(path: Path, rows: int) -> None:
    """Rows as a sweep of as many configurations leaves them."""
    timing = {"n": 8, "median": 1.0, "iqr": 0.1}
    row = asdict(ResultRow(run_id="r", strategy="ngd", dataset="srn_cars/test", device="cpu", cpu="CPU", seed=0))
    row |= dict.fromkeys(("encode_s", "render_s", "distill_s", "scene_s"), timing)
    with open(path, "w", encoding="utf-8") as file:
        for n in range(rows):
            words = ["strategy=ngd", f"budget.inner_steps={n}", f"budget.views={n % 50}", f"lr={n % 977}", "ckpt=demo"]
            own = {"run_id": f"r{n}", "overrides": words, "command": " ".join(words), "psnr": 20 + n % 1000 / 500}
            own["scene_s"] = timing | {"median": 1 + n * 7919 % rows / rows}
            file.write(json.dumps(row | own) + "\n")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("rows", type=int, nargs="+")
    parser.add_argument("--chart", action="store_true", help="also chart them (without PNGs)")
    arguments = parser.parse_args()
    if arguments.chart:
        from nerfdiff.chart.build import build_chart
        from nerfdiff.cli import load_config
    for rows in arguments.rows:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "results.jsonl"
            write(path, rows)
            before, start = peak(), time.process_time()
            found = read_rows(path)
            seconds, size = time.process_time() - start, path.stat().st_size / 1e6
            print(
                f"{len(found)} rows, {size:.0f} MB: read in {seconds:.1f} s of one core, {peak() - before:.0f} MB more"
            )
            del found
            if arguments.chart:
                start = time.process_time()
                build_chart(load_config("chart", [f"results={folder}", "png.costs=[]"]))
                print(f"  charted in {time.process_time() - start:.1f} s, {peak():.0f} MB in all")
        sys.stdout.flush()


def peak() -> float:
    """Megabytes."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3


if __name__ == "__main__":
    main()
