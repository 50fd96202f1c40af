"""Shards of one run, made by many jobs, to one table and one row."""

import json
import logging
import math
import os
import shlex
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import filelock
import numpy as np
import pandas as pd
from omegaconf import DictConfig

from nerfdiff.cli import command_words
from nerfdiff.evaluation.costs import cost_totals
from nerfdiff.evaluation.evaluate import show
from nerfdiff.evaluation.measure import COSTS, SHARD, config_sha256
from nerfdiff.metrics.sets import SETS, FrechetDistance, add_statistics, sets
from nerfdiff.metrics.summary import FACTS, Value, summarise_columns
from nerfdiff.metrics.table import named
from nerfdiff.results.row import ResultRow, append_row, parse_row, read_rows
from nerfdiff.utils.errors import DataError, some
from nerfdiff.utils.files import atomic, encode, write_text
from nerfdiff.utils.hashes import sha256_values
from nerfdiff.utils.shard import Shard

log = logging.getLogger(__name__)

TEXTS = ("scene", "status", "verdict", "conditions")
OF_A_JOB = ("shard", "shards", "sweep")
"""Keys of overrides that say which part of the work is a job's."""


@dataclass(frozen=True)
class Part:
    """A complete shard, as `write_shard` left it.

    Args:
        scores: its folder.
        whole: identity of the run that it is a part of, how it is scored, and what else two parts have to agree in.
    """

    scores: Path
    shard: Shard
    scenes: tuple[str, ...]
    whole: dict[str, Any]
    cost_key: str
    row: ResultRow


def merge_shards(cfg: DictConfig) -> list[ResultRow]:
    """Merge the shards below `cfg.shards`, of every run and strategy there that has them all.

    Leaves in `<cfg.out>/<strategy>-<identity>/scores/<strategy>/` what a run of all scenes leaves: per_scene.csv, in
    the order of shards, and summary.json. Appends a row to `cfg.results`, unless it is there. Scores of images stay
    with their shards.

    Raises:
        DataError: no run there has all its shards (the message says which are missing), or files are damaged.
    """
    folder = Path(cfg.shards)
    runs: dict[str, dict[int, Part]] = {}
    for part in read_parts(folder):
        others = runs.setdefault(sha256_values([part.whole, part.shard.of]), {})
        other = others.get(part.shard.number)
        if other is None or (other.row.time or "") <= (part.row.time or ""):  # the same scenes, made again elsewhere
            others[part.shard.number] = part
    if not runs:
        raise DataError(f"{folder}: no complete shard in it; make some with shard=1/100 to shard=100/100")
    incomplete = {key: parts for key, parts in runs.items() if len(parts) < _of(parts)}
    complete: dict[str, list[Part]] = {}
    for key in sorted(runs.keys() - incomplete.keys(), key=lambda key: _of(runs[key])):
        parts = [runs[key][number] for number in sorted(runs[key])]
        complete.setdefault(sha256_values(parts[0].whole), parts)  # cut in several ways: the fewest shards
    missing = [_missing(parts, list(incomplete.values())) for parts in incomplete.values()]
    if not complete:
        raise DataError(f"{folder}: no run has all its shards. {'; '.join(missing)}")
    for words in missing:
        log.warning("%s", words)
    rows = [_merge(parts, Path(cfg.out), Path(cfg.results), _command(cfg)) for parts in complete.values()]
    show(rows, Path(cfg.out) / "table.md")
    return rows


def read_parts(folder: Path) -> Iterator[Part]:
    """The complete shards below a folder.

    Raises:
        DataError: what one left is damaged.
    """
    for inner, below, files in os.walk(folder):
        below[:] = sorted(set(below) - {"predictions"})
        if SHARD in files:
            yield _read_part(Path(inner))


def _read_part(scores: Path) -> Part:
    path = scores / SHARD
    try:
        facts = json.loads(path.read_text(encoding="utf-8"))
        shard = Shard.read(facts["identity"].pop("shard"))
        whole = {key: facts[key] for key in ("identity", "strategy", "scoring")}
        row = parse_row(json.dumps(facts["row"]).encode(), {})
        return Part(scores, shard, tuple(facts["scenes"]), whole, facts["cost_key"], row)
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise DataError(f"{path}: cannot be read ({error}); run its shard again") from error


def _of(parts: Mapping[int, Part]) -> int:
    return next(iter(parts.values())).shard.of


def _missing(parts: Mapping[int, Part], others: Sequence[Mapping[int, Part]]) -> str:
    """Say which shards of a run are not complete, and in what these differ from others that may be meant for it."""
    first, of = next(iter(parts.values())), _of(parts)
    missing = [number for number in range(1, of + 1) if number not in parts]
    words = f"{first.row.strategy}: {len(missing)} of {of} shards are not complete ({_ranges(missing)})"
    for other in others:
        mate = next(iter(other.values()))
        if other is not parts and (mate.row.strategy, mate.shard.of) == (first.row.strategy, of):
            here, there = (part.whole["identity"] | {"scoring": part.whole["scoring"]} for part in (first, mate))
            differing = [key for key in sorted(here.keys() | there.keys()) if here.get(key) != there.get(key)]
            words += f"; shard {mate.shard} is of another run: it differs in {some(differing)}"
            break
    return f"{words}. Run these again: what is done is kept"


def _ranges(numbers: Sequence[int]) -> str:
    """As Slurm's `--array` takes them: 3,7-9."""
    spans: list[list[int]] = []
    for number in numbers:
        if spans and number == spans[-1][1] + 1:
            spans[-1][1] = number
        else:
            spans.append([number, number])
    return ",".join(f"{first}-{last}" if last > first else str(first) for first, last in spans)


def _merge(parts: Sequence[Part], out: Path, results: Path, command: str) -> ResultRow:
    first = parts[0]
    whole, strategy = first.whole, first.whole["strategy"]
    _check_scenes(parts)
    folder = out / f"{whole['identity']['strategy']['name']}-{sha256_values(whole['identity'])[:8]}"
    scores = folder / "scores" / strategy
    summary = _scores(parts, scores)
    costs = pd.concat([_read_csv(part.scores / COSTS) for part in parts], ignore_index=True)
    (cost_key, _), *others = Counter(part.cost_key for part in parts).most_common()
    typical = next(part for part in parts if part.cost_key == cost_key)  # whose device the seconds are of
    if others:
        log.warning("%s: shards ran under %d conditions; seconds are of the commonest", strategy, 1 + len(others))
    row = replace(
        typical.row,
        run_id=f"{typical.row.run_id.rpartition('/')[0]}/{strategy}-"
        f"{(config := config_sha256(whole['identity'], cost_key, strategy, whole['scoring']))[:8]}",
        config_sha256=config,
        time=max(part.row.time or "" for part in parts),
        status="ok",
        error=None,
        shard=None,
        folder=os.path.relpath(folder, results.parent),
        command=command,
        overrides=[word for word in typical.row.overrides or () if word.lstrip("+").split("=")[0] not in OF_A_JOB],
        **{**dict.fromkeys(("suspects", "verdict")), **summary, **cost_totals(costs, cost_key)},
    )
    row = replace(row, overrides=row.overrides or None, timing_s=_weighed(parts, "timing_s"))
    if row.fallbacks and row.fallbacks == row.n_scenes:
        row = replace(row, status="diverged")
    write_text(scores / "summary.json", json.dumps(encode(summary), indent=1, allow_nan=False) + "\n")
    results.parent.mkdir(parents=True, exist_ok=True)
    with filelock.FileLock(folder / ".row.lock"):
        if results.is_file() and any(_alike(row, other) for other in read_rows(results)):
            log.info("the row of %s is in %s already", row.run_id, results)
        else:
            append_row(results, row)
    log.info("%s: %d scenes of %d shards; scores: %s", strategy, row.n_scenes, len(parts), scores)
    return row


def _check_scenes(parts: Sequence[Part]) -> None:
    """Refuse shards that together are not all scenes of the split, each once."""
    ids = [""] * sum(len(part.scenes) for part in parts)
    for part in parts:
        ids[part.shard.number - 1 :: part.shard.of] = part.scenes
    if sha256_values(ids) != parts[0].whole["identity"]["split_sha256"]:
        raise DataError(
            f"{parts[0].scores.parent}: the shards' scenes are not those of the split; run the shards again"
        )


def _scores(parts: Sequence[Part], out: Path) -> dict[str, Value]:
    """Write the scores of all scenes, and return their summary under the names of `ResultRow`."""
    metrics = named("image", "scene")
    values: dict[str, list[np.ndarray]] = {name: [] for name in metrics}
    blank: list[bool] = []
    views = 0
    fid, fd_st_vgg = FrechetDistance(), FrechetDistance()
    with atomic(out / "per_scene.csv") as temporary, open(temporary, "wb") as file:
        for number, part in enumerate(parts):
            path = part.scores / "per_scene.csv"
            table = _read_csv(path)
            columns = list(table.columns) if not number else columns
            there = list(table.columns) == columns and {*FACTS, *metrics} <= set(columns)
            if not there or tuple(table["scene"]) != part.scenes:
                raise DataError(f"{path}: expected {len(part.scenes)} scenes with {', '.join(columns)}; run it again")
            header, _, lines = path.read_bytes().partition(b"\n")
            file.write(lines if number else header + b"\n" + lines)
            blank += table["blank"].astype(bool).tolist()
            views += int(table["views"].sum())
            for name in metrics:
                values[name].append(table[name].to_numpy("float64"))
            add_statistics(part.scores / SETS, fid=fid, fd_st_vgg=fd_st_vgg)

    def column(name: str) -> list[float | None]:
        return [None if value != value else value for value in np.concatenate(values[name]).tolist()]

    # an empty cell and one that says nan read alike; a shard's mean tells them apart
    broken = [name for name in metrics if any(_is_nan(part.row.measured(name)) for part in parts)]
    summary = summarise_columns(column, blank, views) | sets(fid, fd_st_vgg)
    summary |= dict.fromkeys(broken, math.nan)
    row = parts[0].row
    own = {name: described | {"value": summary.pop(name)} for name, described in (row.own_metrics or {}).items()}
    same = {name: getattr(row, name) for name in ("ssim_impl", "lpips_net")}
    known = asdict(row).keys()
    return {name: value for name, value in summary.items() if name in known} | same | {"own_metrics": own or None}


def _is_nan(value: float | None) -> bool:
    return value is not None and math.isnan(value)


def _weighed(parts: Sequence[Part], name: str) -> float | None:
    """Return the mean over all scenes of a number of which each shard has a mean."""
    pairs = [(getattr(part.row, name), len(part.scenes)) for part in parts if getattr(part.row, name) is not None]
    return sum(value * count for value, count in pairs) / sum(count for _, count in pairs) if pairs else None


def _read_csv(path: Path) -> pd.DataFrame:
    try:
        table = pd.read_csv(path, dtype=dict.fromkeys(TEXTS, str), keep_default_na=False, na_values=[""])
    except (OSError, ValueError) as error:
        raise DataError(f"{path}: cannot be read ({error}); run its shard again") from error
    return table.astype({name: "category" for name in TEXTS[1:] if name in table})  # a few different ones


def _alike(row: ResultRow, other: ResultRow) -> bool:
    return other.run_id == row.run_id and encode(asdict(other)) == json.loads(json.dumps(encode(asdict(row))))


def _command(cfg: DictConfig) -> str:
    words = [f"{key}={cfg[key]}" for key in ("shards", "out", "results")]
    return shlex.join([*command_words("merge_shards"), *words])
