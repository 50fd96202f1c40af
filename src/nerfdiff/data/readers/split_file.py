"""Splits drawn from a seed and kept in a file, so that every run of everybody who has the file uses the same."""

import hashlib
import json
import logging
import math
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path

from nerfdiff.data.formats.json_files import entry, read_json
from nerfdiff.data.readers.index import index_name
from nerfdiff.utils.errors import ConfigError, DataError, some
from nerfdiff.utils.files import write_text
from nerfdiff.utils.hashes import sha256_values

log = logging.getLogger(__name__)


def stored_split(
    root: Path, index_dir: str | Path, ids: Sequence[str], sizes: Mapping[str, int], seed: int
) -> tuple[dict[str, list[str]], str]:
    """The split of these objects, and its SHA-256.

    It is read from `split_seed<seed>.json` in `root`, or else in `index_dir`, and drawn and written there the first
    time (in `index_dir` where `root` cannot be written). With Σ `sizes` objects, the splits get these sizes;
    with any other number, the same proportions of it. To use a split of one's own, write such a file without the
    key "sha256": `{"splits": {"train": [...], "val": [...], "test": [...]}}`; it may leave objects out.

    Raises:
        ConfigError: `sizes` are no sizes.
        DataError: the stored split is damaged, or is not of these objects.
    """
    names = (f"split_seed{seed}.json", f"{index_name('split', root)}_seed{seed}.json")
    files = (root / names[0], Path(index_dir) / names[1])
    for file in files:
        if file.exists():
            return _read(file, ids)
    splits = draw_split(ids, sizes, seed)
    digest = sha256_values(splits)
    text = json.dumps({"seed": seed, "sizes": dict(sizes), "sha256": digest, "splits": splits}, indent=1)
    for file in files:
        try:
            write_text(file, text)
        except DataError as error:
            failure = error
            continue
        _tell(file, digest, tuple((name, len(members)) for name, members in splits.items()), f"drawn from seed {seed}")
        return splits, digest
    log.warning("the split (seed %d, sha256 %s) could not be stored: %s", seed, digest, failure)
    return splits, digest


def draw_split(ids: Sequence[str], sizes: Mapping[str, int], seed: int) -> dict[str, list[str]]:
    """Disjoint random subsets in the proportions of `sizes`, each with at least one object where there are enough.

    Raises:
        ConfigError: `sizes` are negative or all 0.
    """
    total = sum(sizes.values())
    if total <= 0 or min(sizes.values()) < 0:
        raise ConfigError(f"split sizes {dict(sizes)} must be at least 0, and not all 0")
    shares = {name: len(ids) * size / total for name, size in sizes.items()}
    counts = {name: math.floor(share) for name, share in shares.items()}
    for name in sorted(shares, key=lambda name: counts[name] - shares[name])[: len(ids) - sum(counts.values())]:
        counts[name] += 1
    wanted = [name for name, size in sizes.items() if size]
    for name in wanted:
        largest = max(counts, key=counts.get)
        if not counts[name] and counts[largest] > 1:
            counts[name], counts[largest] = 1, counts[largest] - 1
    shuffled = seeded_order(ids, seed)
    splits, start = {}, 0
    for name, count in counts.items():
        splits[name] = sorted(shuffled[start : start + count])
        start += count
    return splits


def seeded_order(ids: Sequence[str], seed: int) -> list[str]:
    """A random order that depends on the names and the seed alone: not on a library, its version or their order."""
    return sorted(ids, key=lambda name: hashlib.sha256(f"{seed} {name}".encode()).digest())


def _read(file: Path, ids: Sequence[str]) -> tuple[dict[str, list[str]], str]:
    values = read_json(file, "expected a split, as {'splits': {'train': [...], ...}}")
    splits = entry(values, "splits", dict, file)
    for name in splits:
        members = entry(splits, name, list, f"{file}: splits")
        if not all(isinstance(member, str) for member in members):
            raise DataError(f"{file}: expected names of objects in the split {name!r}")
    digest = sha256_values(splits)
    if values.get("sha256", digest) != digest:
        raise DataError(
            f"{file}: the split is not the one that its sha256 was taken of; copy the file anew, delete it to draw the "
            "split again, or remove its key 'sha256' to use it as it is"
        )
    listed = [member for members in splits.values() for member in members]
    known, members = set(ids), set(listed)
    if len(members) < len(listed):
        twice = {member for member in members if listed.count(member) > 1}
        raise DataError(f"{file}: objects that are listed twice: {some(twice)}; every object belongs to one split")
    if members - known or ("sha256" in values and known - members):
        raise DataError(
            f"{file}: the split is not of the objects that are there; listed but not there: {some(members - known)}; "
            f"there but not listed: {some(known - members)}; complete the dataset, or delete the file to draw another "
            "split (its results then do not compare with earlier ones)"
        )
    how = "stored" if members == known else f"stored, leaves out {len(known - members)} objects that are there"
    _tell(file, digest, tuple((name, len(members)) for name, members in splits.items()), how)
    return splits, digest


@cache
def _tell(file: Path, digest: str, sizes: tuple[tuple[str, int], ...], how: str) -> None:
    counts = ", ".join(f"{count} {name}" for name, count in sizes)
    log.info("split %s (%s): %s; sha256 %s", file, how, counts, digest[:16])
