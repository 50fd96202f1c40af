"""A measured run as one line of JSON: the schema of every table and chart of this project.

One file holds many runs and only ever grows. Numbers that JSON lacks are the strings "NaN", "Infinity" and
"-Infinity"; null means that something was not measured. A run that failed is a row too, with its status.

This file imports nothing heavy, so that tools can read results without loading PyTorch.
"""

import csv
import fcntl
import io
import json
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from nerfdiff.errors import DataError
from nerfdiff.results.files import write_text

SCHEMA_VERSION = 2
STATUSES = ("ok", "nan", "oom", "diverged", "error", "timeout")
NONFINITE = {"NaN": math.nan, "Infinity": math.inf, "-Infinity": -math.inf}

Timing = dict[str, float | int]


@dataclass(kw_only=True)
class ResultRow:
    """One measured run. None means not measured or not applicable.

    `folder` is where predictions and scores lie, relative to the file of results. `command` makes the row again.
    Timings are dicts {n, median, iqr} in seconds, see `timing`: `encode_s` per image, `render_s` per view (of all
    predicted views of a scene in one call), the others per scene. `scene_s` is a scene from its input image to all its
    predicted views, whatever the method; `distill_s` is that without encoding the image and rendering the views, of
    methods that call the denoiser; `denoise_s` (denoiser calls), `fit_s` (field updates) and `guide_s` (renderings of
    virtual views, which the denoiser sees and is guided by) are parts of it. `timing_s` are the seconds per scene that
    measuring cost the run. `peak_mem_bytes` is what a GPU had allocated; on a CPU the process's resident set, with what
    earlier jobs of a sweep left in it. `backend` is what rendered: `triton`, `torch`, or `cpu`, which is PyTorch in the
    order that suits a CPU. `samples_per_ray` counts coarse and fine ones. `K` counts the virtual views that fields were
    fitted to, the most of any scene. `fid_n` is the number of images on either side of `fid` and `fd_st_vgg`; `n_views`
    counts all scored images; `consistency_n` scenes were measured for consistency. `fallbacks` counts the scenes whose
    distillation failed and which kept an earlier field; `error` says how; where all did, the status is `diverged`. The
    three after it are of the training run that made the checkpoint.
    """

    # identity
    schema_version: int = SCHEMA_VERSION
    run_id: str
    time: str | None = None
    status: str = "ok"
    error: str | None = None
    git_sha: str | None = None
    git_dirty: bool | None = None
    config_sha256: str | None = None
    folder: str | None = None
    command: str | None = None
    overrides: list[str] | None = None
    seed: int | None = None
    dataset: str | None = None
    split_sha256: str | None = None
    n_scenes: int | None = None
    n_views: int | None = None
    image_size: list[int] | None = None
    ckpt_sha256: str | None = None
    weights: str | None = None
    model: str | None = None
    field: str | None = None
    strategy: str | None = None
    prior: str | None = None
    K: int | None = None
    samples_per_ray: int | None = None
    backend: str | None = None
    compile: bool | None = None
    scenes_at_once: int | None = None
    # metrics
    psnr: float | None = None
    ssim: float | None = None
    ssim_impl: str | None = None
    ssim_gaussian: float | None = None
    lpips: float | None = None
    lpips_net: str | None = None
    fid: float | None = None
    fid_n: int | None = None
    st_lpips_vgg: float | None = None
    fd_st_vgg: float | None = None
    sharpness: float | None = None
    depth_abs_rel: float | None = None
    depth_rmse: float | None = None
    mask_iou: float | None = None
    floaters: float | None = None
    depth_extent: float | None = None
    consistency_psnr: float | None = None
    consistency_psnr_truth: float | None = None
    consistency_n: int | None = None
    blank_scenes: int | None = None
    psnr_without_blank: float | None = None
    ssim_without_blank: float | None = None
    lpips_without_blank: float | None = None
    st_lpips_vgg_without_blank: float | None = None
    # cost
    encode_s: Timing | None = None
    render_s: Timing | None = None
    distill_s: Timing | None = None
    denoise_s: Timing | None = None
    fit_s: Timing | None = None
    guide_s: Timing | None = None
    scene_s: Timing | None = None
    timing_s: float | None = None
    denoiser_calls: int | None = None
    field_queries: int | None = None
    peak_mem_bytes: int | None = None
    params: int | None = None
    # environment
    device: str | None = None
    cpu: str | None = None
    torch: str | None = None
    cuda: str | None = None
    precision: str | None = None
    lightning: str | None = None
    hydra: str | None = None
    # stability
    fallbacks: int | None = None
    nonfinite_grad_steps: int | None = None
    loss_spikes: int | None = None
    grad_norm_p99: float | None = None

    def __post_init__(self) -> None:
        if self.status not in STATUSES:
            raise ValueError(f"status {self.status!r} is unknown; choose one of {', '.join(STATUSES)}")
        if self.time is None:
            self.time = datetime.now(UTC).isoformat(timespec="seconds")


def encode(value: Any) -> Any:
    """`value` with non-finite floats as strings, so that it is valid JSON."""
    if isinstance(value, Mapping):
        return {key: encode(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [encode(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return "NaN" if math.isnan(value) else "Infinity" if value > 0 else "-Infinity"
    return value


def append_row(path: str | Path, row: ResultRow) -> None:
    """Add one line, safely beside other writers and whole or not at all.

    Raises:
        DataError: the file cannot be written; it is as it was before.
    """
    line = (json.dumps(encode(asdict(row)), allow_nan=False) + "\n").encode()
    try:
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        file = os.open(path, os.O_RDWR | os.O_APPEND | os.O_CREAT, 0o644)
        try:
            fcntl.flock(file, fcntl.LOCK_EX)
            size = os.fstat(file).st_size
            if size and os.pread(file, 1, size - 1) != b"\n":
                line = b"\n" + line  # a writer was killed halfway: its torn line must not swallow this one
            try:
                if os.write(file, line) != len(line):
                    raise OSError("no space left for a whole line")
                os.fsync(file)
            except OSError:
                os.ftruncate(file, size)
                raise
        finally:
            os.close(file)
    except OSError as error:
        raise DataError(f"cannot append a result to {path}: {error.strerror or error}") from error


def read_rows(path: str | Path) -> list[ResultRow]:
    """All rows of a file, oldest first; writers wait meanwhile, so that none is seen half.

    Raises:
        DataError: the file is missing, a line is damaged, or a row is of another schema version; the message
            names the line.
    """
    try:
        with open(path, encoding="utf-8") as file:
            fcntl.flock(file, fcntl.LOCK_SH)
            lines = file.read().split("\n")
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"cannot read results {path}: {error}") from error
    return [_parse(line, f"{path}, line {number}") for number, line in enumerate(lines, 1) if line.strip()]


def _parse(line: str, where: str) -> ResultRow:
    try:
        values = json.loads(line)
    except ValueError as error:
        raise DataError(f"{where}: not JSON ({error}); remove the line to read the others") from error
    version = values.get("schema_version") if isinstance(values, dict) else None
    if version != SCHEMA_VERSION:
        raise DataError(
            f"{where}: schema version {version!r}, this program reads {SCHEMA_VERSION}; "
            "keep rows of other versions in a file of their own"
        )
    known = {field.name: field.type for field in fields(ResultRow)}
    if unknown := sorted(values.keys() - known.keys()):
        raise DataError(f"{where}: unknown fields {', '.join(unknown)}; was it written by a newer program?")
    try:
        return ResultRow(**{key: _decode(value, known[key]) for key, value in values.items()})
    except (TypeError, ValueError) as error:
        raise DataError(f"{where}: {error}") from error


def _decode(value: Any, kind: Any) -> Any:
    """Undo `encode` in numeric fields; text fields keep their text, whatever it says."""
    if isinstance(value, dict):
        return {key: NONFINITE.get(item, item) for key, item in value.items()}
    return NONFINITE.get(value, value) if kind == float | None and isinstance(value, str) else value


def flatten(row: ResultRow) -> dict[str, Any]:
    """One scalar per column: timings become `<name>_n`, `_median` and `_iqr`, lists words."""
    flat: dict[str, Any] = {}
    for field in fields(row):
        value = getattr(row, field.name)
        if field.type == Timing | None:
            flat |= {f"{field.name}_{part}": (value or {}).get(part) for part in ("n", "median", "iqr")}
        else:
            flat[field.name] = " ".join(map(str, value)) if isinstance(value, list) else value
    return flat


def write_rows_csv(path: str | Path, rows: Sequence[ResultRow]) -> None:
    """Write rows flattened to CSV, atomically; what was not measured is an empty cell."""
    flat = [flatten(row) for row in rows]
    text = io.StringIO()
    columns = list(flat[0]) if flat else [field.name for field in fields(ResultRow)]
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(flat)
    write_text(Path(path), text.getvalue())
