"""Rows are data from strangers, and their writers die: no line is lost without a word, nothing ends in a traceback."""

import csv
import io
import json
import os
import random
import re
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import pytest
from omegaconf import OmegaConf
from rich.console import Console

from chart_fixtures import KNOWN, chart, failed, result, write_results, write_scores, write_sheet
from nerfdiff.results.intervals import Bootstrap
from nerfdiff.results.row import ResultRow, RowFile, append_row, read_rows
from nerfdiff.results.table import markdown, rich_table
from nerfdiff.sweeps.jobs import group, jobs_of
from nerfdiff.sweeps.lines import lines_of
from nerfdiff.sweeps.plan import write_plan
from nerfdiff.sweeps.text import to_csv, to_markdown, to_rich
from nerfdiff.utils.errors import DataError, UserError
from nerfdiff.utils.files import encode

SRC = Path(__file__).parents[2] / "src"
FIELDS = tuple(asdict(result()))
VALUES = (
    None, True, -1, 0, 1.5, 2**70, 10**320, 1e99, -1e99, 1e-320, float("nan"), float("inf"), "NaN", "", "=1+1", "@x",
    "[/bold]", "[bold", "<script>alert(1)</script>", "${oc.env:HOME}", "$`x$", "$x^{$", "_x", "|", "](javascript:x)",
    "\x1b[2J", "\0", "\ud800", "\u202e", "x" * 20_000, "../..", "/etc", [], ["a=1"], [1, 2], [[]], ["x" * 9000], {},
    {"n": 1}, {"n": 1, "median": 1.0, "iqr": "NaN"}, {"n": 1, "median": float("inf"), "iqr": 0.0},
    ["$x^{$=_\n"], [".".join("ab" * 400)],
)  # fmt: skip


def retyped(rng: random.Random, line: bytes) -> bytes:
    values = json.loads(line)
    for name in rng.sample(FIELDS, rng.choice((1, 1, 2, 8))):
        values[name] = rng.choice(VALUES)
    return json.dumps(values).encode()


def truncated(rng: random.Random, line: bytes) -> bytes:
    return line[: rng.randrange(1, len(line))]


def flipped(rng: random.Random, line: bytes) -> bytes:
    damaged = bytearray(line)
    for _ in range(rng.choice((1, 3, 30))):
        damaged[rng.randrange(len(line))] ^= 1 << rng.randrange(8)
    return bytes(damaged)


def deep(rng: random.Random, line: bytes) -> bytes:
    n = rng.choice((3, 500, 50_000))
    return rng.choice((b"[" * n, b'{"a":' * n, line.replace(b'"error": null', b'"error": ' + b"[" * n + b"]" * n)))


def other(rng: random.Random, line: bytes) -> bytes:
    stray = (
        b"\0" * 4096,
        b"\xff\xfe",
        b"null",
        b"7" * 5000,
        b"{}",
        line + line,
        line.replace(b'"run_id"', b'"run_ID"'),
    )
    return rng.choice((*stray, line.replace(b": 2,", b": 1,", 1), b'{"schema_version": 2, "run_id": "only"}'))


DAMAGE: tuple[Callable[[random.Random, bytes], bytes], ...] = (retyped, retyped, truncated, flipped, deep, other)


HOSTILE = "[/bold]\x1b[2J\n$x^{$|<b>"


def hostile() -> ResultRow:
    """A whole row, of which every text is meant to do harm."""
    texts = dict.fromkeys(("dataset", "device", "model", "field", "weights", "folder", "error", "command"), HOSTILE)
    return result(strategy=HOSTILE, overrides=[f"strategy={HOSTILE}", HOSTILE], run_id="hostile", **texts)


def damaged_file(path: Path, seed: int, lines: int) -> int:
    """Good rows of `KNOWN`, and damaged lines between them; returns how many lines are not empty."""
    rng = random.Random(seed)
    rows = [hostile(), *(result(name, folder=f"run{n}") for n, name in enumerate(KNOWN))]
    good = [json.dumps(encode(asdict(row))).encode() for row in rows]
    bad = [rng.choice(DAMAGE)(rng, rng.choice(good)) for _ in range(lines)]
    content = [*bad, *good]
    rng.shuffle(content)
    data = b"\n".join(content) + rng.choice((b"\n", b"", b'\n{"torn'))
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)
    return sum(bool(line.strip()) for line in data.split(b"\n"))


def check_reading(path: Path, lines: int) -> list[ResultRow]:
    """Every line is a row, or counted and told."""
    file = RowFile(path)
    rows = file.read()
    assert len(rows) + file.skipped.lines == lines
    assert {"hostile", *(f"{name}-0" for name in KNOWN)} <= {row.run_id for row in rows}
    return rows


def check_tables(folder: Path, rows: list[ResultRow]) -> None:
    """Of an evaluation and of a sweep: each row is a line, and a terminal gets no control characters."""
    screen = io.StringIO()
    console = Console(file=screen, width=200)
    assert len(markdown(rows).splitlines()) == len(rows) + 2
    console.print(rich_table(rows, 200, "title"))
    write_plan(folder, [row.overrides or () for row in rows])
    sweep = OmegaConf.create({"hydra": {"sweep": {"dir": str(folder)}, "sweeper": {"proposals": None}}})
    groups = group(jobs_of(sweep), ["strategy"])
    lines = lines_of(groups, Bootstrap(20, 0.9, 0), {"strategy": "none"}, {}, [])
    assert sum(len(found.jobs) for found in groups) and len(lines) == len(groups)
    console.print(to_rich(lines))
    assert to_markdown(lines).split("\n\n")[0].count("\n") == len(lines) + 1
    assert len(list(csv.DictReader(io.StringIO(to_csv(lines))))) == len(lines)
    assert "\x1b" not in screen.getvalue()


def check_chart(folder: Path, rows: list[ResultRow], skipped: int, **settings: object) -> None:
    """The page has every run, and says what was skipped."""
    page = chart(folder, bootstrap__resamples=20, **settings)
    content = re.search(r'<script type="application/json" id="data">(.*?)</script>', page.read_text(), re.S)[1]
    known = json.loads(content, parse_constant=pytest.fail)
    assert known["counts"].startswith(f"{len(rows)} runs")
    assert any(f"{skipped} line" in line for line in known["unread"]) == bool(skipped)
    with open(page.parent / "runs.csv", newline="") as file:
        assert len(list(csv.DictReader(file))) == len(rows)


def damage_pictures_and_scores(folder: Path, seed: int) -> None:
    rng = random.Random(seed)
    for n, (strategy, *_) in enumerate(KNOWN.values()):
        run = folder / f"run{n}"
        write_scores(run, strategy, {"a": 1.0, "b": 2.0})
        write_sheet(run, 32)
        for path in (run / "sheet.png", run / "scores" / strategy / "per_scene.csv"):
            path.write_bytes(rng.choice((truncated, flipped))(rng, path.read_bytes()))


def fuzz(folder: Path, seed: int, lines: int, **settings: object) -> None:
    path = folder / "results.jsonl"
    count = damaged_file(path, seed, lines)
    rows = check_reading(path, count)
    damage_pictures_and_scores(folder, seed)
    check_tables(folder, rows)
    check_chart(folder, rows, count - len(rows), **settings)


@pytest.mark.parametrize("seed", range(4))
def test_no_damaged_line_ends_in_a_traceback_or_is_lost_without_a_word(tmp_path, seed):
    fuzz(tmp_path, seed, lines=40, **({"png__costs": ["scene_s"]} if seed == 0 else {}))


def test_every_value_in_every_field_is_a_row_or_is_told(tmp_path):
    row = asdict(result())
    path = tmp_path / "results.jsonl"
    lines = [json.dumps(row | {name: value}) for name in FIELDS for value in VALUES]
    path.write_text("\n".join(lines))
    file = RowFile(path)
    assert len(file.read()) + file.skipped.lines == len(lines) and file.skipped.lines > len(lines) / 2


@pytest.mark.faults
@pytest.mark.parametrize("seed", range(100, 200))
def test_long_fuzz(tmp_path, seed):
    fuzz(tmp_path, seed, lines=100, **({"png__costs": ["scene_s"]} if seed % 10 == 0 else {}))


def test_results_in_which_nothing_is_a_row_are_an_error_of_one_line(tmp_path):
    for n, content in enumerate((b"\0" * 999, b"[" * 99_999, b'{"schema_version": 3}\n')):
        folder = write_results(tmp_path / str(n))
        (folder / "results.jsonl").write_bytes(content)
        with pytest.raises(UserError) as raised:
            chart(folder)
        assert str(raised.value).count("\n") == 0 and len(str(raised.value)) < 500


WRITER = """
import sys
from nerfdiff.results.row import ResultRow, append_row
path, name = sys.argv[1:]
for i in range(100_000):
    append_row(path, ResultRow(run_id=f"{name}-{i}", error="x" * 5000))
    print(f"{name}-{i}", flush=True)  # from here on it is not to be lost
"""


def kill_writers(path: Path, writers: int, seconds: float) -> int:
    """Start writers, kill them after a while; returns how many rows they said were written, all of which are there."""
    environment = os.environ | {"PYTHONPATH": str(SRC)}
    names = [f"{path.stem}{seconds:.3f}w{n}" for n in range(writers)]
    started = [
        subprocess.Popen([sys.executable, "-c", WRITER, path, name], env=environment, stdout=subprocess.PIPE)
        for name in names
    ]
    said = [process.stdout.readline() for process in started]  # all are at it
    time.sleep(seconds)
    for process in started:
        process.send_signal(signal.SIGKILL)
    said += [process.communicate()[0] for process in started]
    told = {line for text in said for line in text.decode().split("\n")[:-1]}
    assert told <= {row.run_id for row in read_rows(path)}
    return len(told)


def test_writers_that_are_killed_lose_no_row_that_they_wrote(tmp_path):
    assert kill_writers(tmp_path / "results.jsonl", 2, 0.05) >= 2
    append_row(tmp_path / "results.jsonl", result())
    assert read_rows(tmp_path / "results.jsonl")[-1].run_id == "good-0"


@pytest.mark.faults
def test_six_writers_killed_twenty_times(tmp_path):
    rng = random.Random(0)
    for _ in range(20):
        kill_writers(tmp_path / "results.jsonl", 6, rng.uniform(0, 0.3))
    file = RowFile(tmp_path / "results.jsonl")
    assert file.read() and file.skipped.lines <= 20 * 6


def append_until_refused(path: Path) -> int:
    """How many rows were written."""
    for written in range(1000):
        try:
            append_row(path, failed())
        except DataError:
            return written
    raise AssertionError("there was room for everything")


def test_a_file_that_may_not_grow_keeps_whole_rows(tmp_path):
    path = tmp_path / "results.jsonl"
    limits, handler = resource.getrlimit(resource.RLIMIT_FSIZE), signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, limits[1]))
        written = append_until_refused(path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, handler)
    file = RowFile(path)
    assert len(file.read()) == written > 0 and not file.skipped.lines
    append_row(path, result())
    assert len(file.read()) == written + 1


@pytest.mark.faults
def test_a_full_disk_keeps_whole_rows(tmp_path):
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=64k", "none", tmp_path], capture_output=True).returncode:
        pytest.skip("mounting a small disk needs root")
    try:
        path = tmp_path / "results.jsonl"
        written = append_until_refused(path)
        file = RowFile(path)
        assert len(file.read()) == written > 0 and not file.skipped.lines
        with pytest.raises(UserError):
            chart(tmp_path)
        assert len(read_rows(path)) == written
    finally:
        subprocess.run(["umount", tmp_path], check=True)
