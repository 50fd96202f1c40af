"""A measured run as one line of JSON: the schema of every table and chart of this project.

One file holds many runs and only ever grows. Numbers that JSON lacks are the strings "NaN", "Infinity" and
"-Infinity"; null means that something was not measured. A run that failed is a row too, with its status.

This file imports nothing heavy, so that tools can read results without loading PyTorch.
"""

import fcntl
import json
import logging
import math
import os
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields, make_dataclass, replace
from dataclasses import field as has
from datetime import UTC, datetime
from pathlib import Path
from typing import IO, Any, get_args

from nerfdiff.metrics.table import PACKAGE, TAKEN, Metric, register
from nerfdiff.utils.errors import ConfigError, DataError, some
from nerfdiff.utils.files import NONFINITE, encode

log = logging.getLogger(__name__)

SCHEMA_VERSION = 2
RESULTS = "results.jsonl"
STATUSES = ("ok", "nan", "oom", "diverged", "error", "timeout")

LARGEST = 1e100  # number, if finite
LONGEST = 2**20  # bytes of a line
LONGEST_ERROR = 50_000  # letters of one, of which a run that failed writes the beginning
MANY = 1000  # overrides of a row
TOLD = 3  # lines that are no rows, with the reason
WORDS = 100_000  # texts that rows share in memory

Timing = dict[str, float | int]
PARTS = ("n", "median", "iqr")


OwnMetrics = dict[str, dict[str, Any]]
"""Somebody's own metrics, by name: `value`, and the arguments of `Metric` that describe them wherever the row goes."""


@dataclass(kw_only=True, slots=True)
class _Identity:
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
    shard: str | None = None
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
    stress: str | None = None
    severity: float | None = None
    neutral: float | None = None


_WITHOUT_BLANK = [f"{metric.name}_without_blank" for metric in PACKAGE if metric.compared]
_NUMBERS = [(name, float | None, None) for name in (*(metric.name for metric in PACKAGE), *_WITHOUT_BLANK)]


@dataclass(kw_only=True, slots=True)
class ResultRow(make_dataclass("_Measured", _NUMBERS, bases=(_Identity,), kw_only=True, slots=True)):
    """One measured run. None means not measured or not applicable.

    `stress` is what went wrong on purpose, `severity` by how much in its own unit, `neutral` the severity of no stress.
    `shard` is the part of the split (3/100) that a job of many made; `split_sha256` is of the whole split.
    `folder` is where predictions and scores lie, relative to the file of results. `command` makes the row again.
    Timings are dicts {n, median, iqr} in seconds, see `timing`: `encode_s` per image, `render_s` per view (of all
    predicted views of a scene in one call), the others per scene. `scene_s` is a scene from its input image to all its
    predicted views, whatever the method; `distill_s` is that without encoding the image and rendering the views, of
    methods that call the denoiser; `denoise_s` (denoiser calls), `fit_s` (field updates) and `guide_s` (renderings of
    virtual views, which the denoiser sees and is guided by) are parts of it. `timing_s` are the seconds per scene that
    measuring cost the run. `field_bytes` are of all scenes' fields, as
    they are stored. `peak_mem_bytes` is what a GPU had allocated; on a CPU the process's resident set, with what
    earlier jobs of a sweep left in it. `backend` is what rendered: `triton`, `torch`, or `cpu`, which is PyTorch in the
    order that suits a CPU. `samples_per_ray` counts coarse and fine ones. `K` counts the virtual views that fields were
    fitted to, the most of any scene. `fid_n` is the number of images on either side of `fid` and `fd_st_vgg`; `n_views`
    counts all scored images; `consistency_n` scenes were measured for consistency. Scenes' counts have medians, too:
    `steps_median` is how many steps the teacher took, of `steps_planned`; `stopped_by` counts why scenes ended: by
    their `schedule`, all of it done; by `agreement` or a `deadline`, with less. `fallbacks` counts the scenes whose
    distillation failed and which kept an earlier field; `error` says how; where all did, the status is `diverged`.
    `suspects` counts the scenes that the judge suspects, and `verdict` is `ok`, or says of how many what it suspects.
    The last three are of the training run that made the checkpoint.
    """

    # metrics, beside those of `METRICS`
    ssim_impl: str | None = None
    lpips_net: str | None = None
    fid_n: int | None = None
    consistency_n: int | None = None
    blank_scenes: int | None = None
    own_metrics: OwnMetrics | None = None
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
    denoiser_calls_median: float | None = None
    field_queries_median: float | None = None
    steps_median: float | None = None
    steps_planned: int | None = None
    stopped_by: str | None = None
    field_bytes: int | None = None
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
    suspects: int | None = None
    verdict: str | None = None
    nonfinite_grad_steps: int | None = None
    loss_spikes: int | None = None
    held_out_loss: float | None = None
    grad_norm_p99: float | None = None

    def __post_init__(self) -> None:
        if self.status not in STATUSES:
            raise ValueError(f"status {self.status!r} is unknown; choose one of {', '.join(STATUSES)}")
        if self.time is None:
            self.time = datetime.now(UTC).isoformat(timespec="seconds")

    def measured(self, name: str) -> Any:
        """A field, or the value of an own metric, by its name; None where it was not measured."""
        return self.own_metrics[name]["value"] if name in (self.own_metrics or ()) else getattr(self, name, None)


def append_row(path: str | Path, row: ResultRow) -> None:
    """Add one line, safely beside other writers and whole or not at all; of a very long error the beginning.

    Raises:
        DataError: the file cannot be written; it is as it was before.
    """
    path = Path(path)
    if row.error is not None:
        row = replace(row, error=row.error[:LONGEST_ERROR])
    line = (json.dumps(encode(asdict(row)), allow_nan=False) + "\n").encode()
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
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
            if not size:
                _keep_name(path.parent)
        finally:
            os.close(file)
    except OSError as error:
        raise DataError(f"cannot append a result to {path}: {error.strerror or error}") from error


def _keep_name(folder: Path) -> None:
    """A new file's name survives a power cut only when its folder is on the disk too."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


@dataclass
class Skipped:
    """Lines of a file of results that are no rows: how many, and what is wrong with the first few.

    Args:
        torn: what is wrong with the last line, where it has no end.
    """

    path: Path
    whole: int = 0
    reasons: list[str] = has(default_factory=list)
    torn: str | None = None

    @property
    def lines(self) -> int:
        return self.whole + (self.torn is not None)

    def add(self, reason: str) -> None:
        self.whole += 1
        if len(self.reasons) < TOLD:
            self.reasons.append(reason)

    def __str__(self) -> str:
        what = "1 line is no row and was" if self.lines == 1 else f"{self.lines} lines are no rows and were"
        told = [*self.reasons, *filter(None, [self.torn])]
        more = f"; and {self.lines - len(told)} more" if self.lines > len(told) else ""
        return f"{self.path}: {what} skipped: {'; '.join(told)}{more}"


class RowFile:
    """The rows of one file of results, oldest first. Lines that are no rows are skipped, counted and warned of.

    Reads line by line, and what it has read it does not read again: many readings of a growing file cost as much as
    one. Writers wait only while the end of the file is looked up; a row is seen whole or not at all.
    """

    def __init__(self, path: str | Path):
        self.path = Path(path)
        self._restart()

    def _restart(self) -> None:
        self.rows: list[ResultRow] = []
        self.skipped = Skipped(self.path)
        self._offset, self._number, self._foreign, self._warned = 0, 0, False, ""
        self._words: dict[str, str] = {}

    def read(self) -> list[ResultRow]:
        """All rows, with those that were added since the last reading.

        Raises:
            DataError: the file is missing, cannot be read, or has rows of another schema alone.
        """
        try:
            if self.path.exists() and not self.path.is_file():
                raise DataError(f"cannot read results {self.path}: it is not a file")
            with open(self.path, "rb") as file:
                fcntl.flock(file, fcntl.LOCK_SH)
                end = os.fstat(file.fileno()).st_size
                fcntl.flock(file, fcntl.LOCK_UN)
                if end < self._offset:  # somebody edited it
                    self._restart()
                file.seek(self._offset)
                self._read(file, end)
        except OSError as error:
            raise DataError(f"cannot read results {self.path}: {error}") from error
        if self._foreign and not self.rows:
            raise DataError(str(self.skipped))
        if self.skipped.lines and str(self.skipped) != self._warned:
            self._warned = str(self.skipped)
            log.warning("%s", self._warned)
        return self.rows

    def _read(self, file: IO[bytes], end: int) -> None:
        self.skipped.torn = None  # somebody may have gone on with it
        while self._offset < end:
            line = file.readline(min(LONGEST, end - self._offset))
            reason = _longer(file, line, end) if len(line) == LONGEST else None
            whole = reason is not None or line.endswith(b"\n")
            if reason is None and line.strip():
                try:
                    self.rows.append(parse_row(line, self._words))
                    whole = True
                except RecursionError:
                    reason = "nested too deep"
                except ValueError as error:
                    self._foreign |= isinstance(error, ForeignRow)
                    reason = str(error)
            if reason is not None and not whole:
                self.skipped.torn = f"line {self._number + 1}: {reason}"
                return
            self._offset = file.tell()
            self._number += 1
            if reason is not None:
                self.skipped.add(f"line {self._number}: {reason}")


def _longer(file: IO[bytes], line: bytes, end: int) -> str | None:
    """Skip the rest of a line that is too long."""
    if line.endswith(b"\n"):
        return None
    while file.tell() < end and not line.endswith(b"\n"):
        line = file.readline(min(LONGEST, end - file.tell()))
    return f"longer than {LONGEST} bytes"


def read_rows(path: str | Path) -> list[ResultRow]:
    """All rows of a file, oldest first; see `RowFile`.

    Raises:
        DataError: see `RowFile.read`.
    """
    return RowFile(path).read()


class ForeignRow(ValueError):
    """A whole row, of another schema."""


def parse_row(line: bytes, words: dict[str, str]) -> ResultRow:
    """A row; equal texts of rows are one object in `words`.

    Raises:
        ValueError: the line is no row, or not of this schema.
    """
    try:
        values = json.loads(line.decode())
    except ValueError as error:
        raise ValueError(f"not JSON ({error})") from error
    if not isinstance(values, dict):
        raise ValueError("not a JSON object")
    version = values.get("schema_version")
    if version != SCHEMA_VERSION:
        raise ForeignRow(
            f"schema version {_shown(version)}, this program reads {SCHEMA_VERSION}; "
            "keep rows of other versions in a file of their own"
        )
    if unknown := values.keys() - KINDS.keys():
        names = some([_shown(name) for name in unknown])
        raise ForeignRow(f"unknown fields {names}; was it written by a newer program?")
    if values.get("run_id") is None:
        raise ValueError("no run_id")
    if b"\\ud" in line or b"\\uD" in line:
        values = {key: _writable(value) for key, value in values.items()}
    decoded = {}
    for key, value in values.items():
        if value is None:
            continue
        name, wanted, accept = KINDS[key]
        decoded[name] = found = accept(value)
        if found is None:
            raise ValueError(f"{name} is to be {wanted}, it is {_shown(value)}")
        if len(words) < WORDS:
            if type(found) is str:
                decoded[name] = words.setdefault(found, found)
            elif name == "overrides":
                decoded[name] = [words.setdefault(word, word) for word in found]
    if "status" in decoded and decoded["status"] not in STATUSES:
        raise ForeignRow(f"status {_shown(decoded['status'])} is unknown; was it written by a newer program?")
    return ResultRow(**decoded)


def _writable(value: Any) -> Any:
    """Text without half pairs of surrogates, which no file can hold."""
    if isinstance(value, list):
        return [_writable(item) for item in value]
    return value.encode(errors="replace").decode() if isinstance(value, str) else value


def _shown(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:59]}…"


def _float(value: Any) -> float | None:
    """Undo `encode`."""
    if type(value) is str:
        return NONFINITE.get(value)
    fits = type(value) in (float, int) and not LARGEST <= abs(value) < math.inf
    return value if fits else None


def _count(value: Any) -> int | None:
    return value if type(value) is int and 0 <= value < 2**63 else None


def _timing(value: Any) -> Timing | None:
    if type(value) is not dict or value.keys() != set(PARTS):
        return None
    found = {"n": _count(value["n"]), "median": _float(value["median"]), "iqr": _float(value["iqr"])}
    return None if None in found.values() else found


def _texts(value: Any) -> list[str] | None:
    fits = type(value) is list and len(value) <= MANY and all(type(item) is str for item in value)
    return value if fits else None


def _size(value: Any) -> list[int] | None:
    fits = type(value) is list and len(value) == 2 and all(_count(item) is not None for item in value)
    return value if fits else None


def _own_metrics(value: Any) -> OwnMetrics | None:
    """Registered, so that tables and charts know them."""
    if type(value) is not dict or len(value) > MANY:
        return None
    found = {}
    for name, described in value.items():
        if type(described) is not dict or name in TAKEN or "name" in described or "measure" in described:
            return None
        number = described.get("value")
        decoded = None if number is None else _float(number)
        if number is not None and decoded is None:
            return None
        try:
            register(Metric(name, **{key: text for key, text in described.items() if key != "value"}))
        except (TypeError, ConfigError):
            return None
        found[name] = described | {"value": decoded}
    return found


def _is(kind: type) -> Callable[[Any], Any]:
    return lambda value: value if type(value) is kind else None


ACCEPTED: dict[Any, tuple[str, Callable[[Any], Any]]] = {
    str: ("text", _is(str)),
    bool: ("true or false", _is(bool)),
    int: ("a whole number, not negative", _count),
    float: (f"a number below {LARGEST:g}", _float),
    list[str]: (f"a list of at most {MANY} texts", _texts),
    list[int]: ("a height and a width", _size),
    Timing: ("a timing {n, median, iqr}", _timing),
    OwnMetrics: ("metrics {name: {value, label, better, …}}", _own_metrics),
}
SEED = ("a whole number", lambda value: value if type(value) is int and abs(value) < 2**63 else None)
# by the name in a file: the field's name (the same object every time, which makes rows fast), what it holds, and what
# gives the value of what was read, or None
KINDS = {
    f.name: (f.name, *(SEED if f.name == "seed" else ACCEPTED[(get_args(f.type) or (f.type,))[0]]))
    for f in fields(ResultRow)
}


TIMINGS = {f.name: tuple(f"{f.name}_{part}" for part in PARTS) for f in fields(ResultRow) if f.type == Timing | None}
TAKEN.update(KINDS)
COLUMNS = tuple(c for f in fields(ResultRow) if f.name != "own_metrics" for c in TIMINGS.get(f.name, (f.name,)))


def flatten(row: ResultRow) -> dict[str, Any]:
    """One scalar per column: timings become `<name>_n`, `_median` and `_iqr`, lists words, own metrics columns."""
    flat: dict[str, Any] = {}
    for name in KINDS:
        value = getattr(row, name)
        if name == "own_metrics":
            flat |= {own: metric["value"] for own, metric in (value or {}).items()}
        elif name in TIMINGS:
            flat |= zip(TIMINGS[name], map((value or {}).get, PARTS), strict=True)
        else:
            flat[name] = " ".join(map(str, value)) if isinstance(value, list) else value
    return flat
