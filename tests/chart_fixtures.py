"""Results as evaluations and sweeps leave them, with numbers that are known."""

from copy import deepcopy
from functools import cache
from pathlib import Path

import numpy as np
from omegaconf import OmegaConf
from PIL import Image

from nerfdiff.chart.build import build_chart
from nerfdiff.cli import load_config
from nerfdiff.results.row import ResultRow, append_row

SCENES = ("a", "b", "c")
# name: strategy, cost in seconds, PSNR, ST-LPIPS; which of them no other dominates is plain to see
KNOWN = {
    "cheap": ("none", 1.0, 20.0, 0.30),
    "worse": ("direct", 4.0, 19.0, 0.25),
    "good": ("ngd", 8.0, 22.0, 0.20),
    "slow": ("ngd", 16.0, 21.9, 0.10),
    "best": ("sds", 32.0, 22.05, 0.15),
}
STEPS = dict(zip(KNOWN, (1, 2, 4, 8, 16), strict=True))  # an override in which they differ
TIME = "2026-01-01T00:00:00+00:00"
FRONTIERS = {"psnr": ["cheap", "good", "best"], "st_lpips_vgg": ["cheap", "worse", "good", "slow"]}


def timing(median: float, iqr: float = 0.0) -> dict:
    return {"n": 3, "median": median, "iqr": iqr}


def result(name: str = "good", seed: int = 0, **values) -> ResultRow:
    """One of `KNOWN`, measured on a CPU on three scenes of four views."""
    strategy, seconds, psnr, st_lpips = KNOWN[name]
    overrides = [f"seed={seed}", f"strategy={strategy}", f"budget.inner_steps={STEPS[name]}", "ckpt=demo"]
    base = {
        "run_id": f"{name}-{seed}", "time": TIME, "status": "ok",
        "command": f"python src/distill.py {' '.join(overrides)}", "overrides": overrides,
        "seed": seed, "dataset": "srn_cars/test", "split_sha256": "f00", "n_scenes": 3, "n_views": 12,
        "image_size": [32, 32], "strategy": strategy, "psnr": psnr, "st_lpips_vgg": st_lpips,
        "scene_s": timing(seconds, seconds / 10), "denoiser_calls": 0 if strategy == "none" else round(3 * seconds),
        "params": 5_000_000, "device": "cpu", "cpu": "Test CPU",
    }  # fmt: skip
    return ResultRow(**base | values)


def failed(name: str = "good", seed: int = 0, **values) -> ResultRow:
    """As a run leaves it that ended before anything was measured."""
    nothing = {"psnr": None, "st_lpips_vgg": None, "scene_s": None, "denoiser_calls": None, "device": None, "cpu": None}
    return result(name, seed, **nothing | {"status": "oom", "error": "CUDA out of memory"} | values)


def write_results(folder: Path, *rows: ResultRow) -> Path:
    """The folder, with a file of these rows."""
    for row in rows:
        append_row(folder / "results.jsonl", row)
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def write_scores(folder: Path, strategy: str, psnr: dict[str, float]) -> None:
    """The PSNR of each scene of a run, in its folder."""
    path = folder / "scores" / strategy / "per_scene.csv"
    path.parent.mkdir(parents=True)
    lines = [f"{scene},4,ok,0,{value},\n" for scene, value in psnr.items()]
    path.write_text("scene,views,status,blank,psnr,ssim\n" + "".join(lines))


def write_sheet(folder: Path, width: int = 640) -> None:
    noise = np.random.default_rng(0).integers(0, 255, (width // 2, width, 3), dtype=np.uint8)
    folder.mkdir(parents=True, exist_ok=True)
    Image.fromarray(noise).save(folder / "sheet.png")


CONFIG = cache(lambda: load_config("chart", ["results=???"]))


def chart(results: object, **settings: object) -> Path:
    """The page of some results; a setting's key has __ for its dots. No PNGs unless asked for: they take longest."""
    cfg = deepcopy(CONFIG())
    cfg.results = list(map(str, results)) if isinstance(results, list) else str(results)
    for key, value in ({"png__costs": []} | settings).items():
        OmegaConf.update(cfg, key.replace("__", "."), value, merge=False)
    return build_chart(cfg)
