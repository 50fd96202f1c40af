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


def write_scores(folder: Path, strategy: str, psnr: dict[str, float], **others: dict[str, object]) -> None:
    """The PSNR of each scene of a run, and other columns, in its folder."""
    path = folder / "scores" / strategy / "per_scene.csv"
    path.parent.mkdir(parents=True)
    columns = {"psnr": psnr, "ssim": {}} | others
    lines = [
        ",".join([scene, "4", "ok", "0", *(str(own.get(scene, "")) for own in columns.values())]) for scene in psnr
    ]
    path.write_text("\n".join([",".join(["scene", "views", "status", "blank", *columns]), *lines, ""]))


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


SIXTEEN = [f"s{number}" for number in range(16)]
# strategy: seconds, PSNR above that of none (and what alternates from scene to scene), ST-LPIPS, whether it has a field
ANSWERS = {
    "none": (1.0, 0.0, 0.0, 0.30, True),
    "cdm": (2.0, -1.0, 0.1, 0.05, False),
    "direct": (4.0, 0.05, 0.4, 0.25, True),
    "ngd": (8.0, 1.0, 0.1, 0.20, True),
    "sds": (12.0, -2.0, 0.1, 0.15, True),
    "ngd_current": (16.0, 1.05, 0.5, 0.20, True),
    "ngd_sharp": (20.0, 0.5, 0.1, 0.10, True),
}


def answering(folder: Path, scenes: list[str] = SIXTEEN) -> Path:
    """Results of which each verdict is known: scenes differ by far more than strategies do."""
    hard = {scene: 20.0 + 0.5 * number for number, scene in enumerate(scenes)}
    for strategy, (seconds, above, wave, perceptual, has_field) in ANSWERS.items():
        psnr = {scene: round(hard[scene] + above + wave * (-1) ** at, 6) for at, scene in enumerate(scenes)}
        st_lpips = {scene: perceptual + 0.01 * (at % 3) for at, scene in enumerate(scenes)}
        spent = {scene: seconds + (15 - at) * (strategy == "ngd_sharp") for at, scene in enumerate(scenes)}
        write_scores(folder / strategy, strategy, psnr, st_lpips_vgg=st_lpips, distill=spent)
        if strategy in ("ngd", "none"):
            write_sheet(folder / strategy)
        row = result(
            strategy=strategy, overrides=[f"strategy={strategy}", "ckpt=demo"], run_id=strategy, folder=strategy,
            command=f"python src/distill.py strategy={strategy} ckpt=demo", scene_s=timing(seconds),
            psnr=sum(psnr.values()) / len(psnr), st_lpips_vgg=sum(st_lpips.values()) / len(st_lpips),
            denoiser_calls=0 if strategy == "none" else 48, K=16 if has_field and strategy != "none" else None,
            field="triplane", n_scenes=len(scenes),
        )  # fmt: skip
        write_results(folder, row)
    return folder
