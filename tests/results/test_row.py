import csv
import fcntl
import json
import math
import os
import re
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from pathlib import Path

import pytest

from nerfdiff.results import row as rows_module
from nerfdiff.results.row import COLUMNS, ResultRow, RowFile, append_row, flatten, read_rows
from nerfdiff.results.text import write_csv
from nerfdiff.utils.errors import DataError

SRC = Path(__file__).parents[2] / "src"
CONTRACT = {
    *("schema_version", "run_id", "status", "error", "git_sha", "git_dirty", "config_sha256", "overrides"),
    *("seed", "dataset", "split_sha256", "n_scenes", "n_views", "ckpt_sha256", "weights", "strategy", "prior"),
    *("K", "psnr", "ssim", "ssim_impl", "lpips", "lpips_net", "fid", "fid_n", "st_lpips_vgg", "fd_st_vgg"),
    *("encode_s", "render_s", "distill_s", "denoiser_calls", "field_queries", "peak_mem_bytes", "params"),
    *("command", "model", "field", "samples_per_ray", "backend", "compile", "scenes_at_once"),
    *("denoise_s", "fit_s", "guide_s", "scene_s", "timing_s"),
    *("device", "cpu", "torch", "cuda", "precision", "lightning", "hydra"),
    *("nonfinite_grad_steps", "loss_spikes", "grad_norm_p99"),
}


def row(**values):
    timing = {"n": 3, "median": 0.25, "iqr": 0.01}
    base = {"run_id": "r1", "psnr": 21.5, "overrides": ["model=tiny", "seed=1"], "encode_s": timing}
    return ResultRow(**base | values)


def test_rows_come_back_as_they_were(tmp_path):
    rows = [
        row(),
        row(run_id="r2", status="error", error="NaN", psnr=None, git_dirty=True, image_size=[64, 64]),
    ]
    for r in rows:
        append_row(tmp_path / "new" / "results.jsonl", r)
    assert read_rows(tmp_path / "new" / "results.jsonl") == rows


def test_non_finite_numbers_survive_in_valid_json(tmp_path):
    path = tmp_path / "results.jsonl"
    append_row(path, row(psnr=math.nan, fid=math.inf, encode_s={"n": 1, "median": -math.inf, "iqr": 0.0}))

    def refuse(name):
        raise AssertionError(f"{name} is not JSON")

    json.loads(path.read_text(), parse_constant=refuse)
    (back,) = read_rows(path)
    assert math.isnan(back.psnr) and back.fid == math.inf and back.encode_s["median"] == -math.inf


def test_the_schema_has_every_field_of_the_contract():
    assert asdict(row()).keys() >= CONTRACT


def test_unknown_status_is_refused():
    with pytest.raises(ValueError, match="'fine' is unknown; choose one of ok, nan, oom"):
        row(status="fine")


def test_a_file_of_another_schema_alone_is_refused_and_single_rows_are_skipped(tmp_path):
    path = tmp_path / "results.jsonl"
    append_row(path, row(schema_version=1))
    with pytest.raises(DataError, match=r"results\.jsonl: 1 line .* line 1: schema version 1, this program reads 2"):
        read_rows(path)
    append_row(path, row())
    file = RowFile(path)
    assert len(file.read()) == 1 and file.skipped.lines == 1 and "line 1: schema version 1" in str(file.skipped)


def line_with(**values):
    return json.dumps(asdict(row()) | values)


DAMAGED = {
    '{"schema_version": 2, "run': "not JSON",
    "\0" * 4096: "not JSON",
    "[1]": "not a JSON object",
    '{"schema_version": 2, "run_id": "x", "psnrr": 3}': "unknown fields 'psnrr'",
    '{"schema_version": 2}': "no run_id",
    "[" * 100_000: "nested too deep",
    '{"a":' * 100_000: "nested too deep",
    "7" * 10_000: "not JSON",
    line_with(psnr="high"): "psnr is to be a number below 1e\\+100, it is 'high'",
    line_with(psnr=True): "psnr is to be",
    line_with(psnr=1e300): "psnr is to be",
    line_with(psnr=10**400): "psnr is to be",
    line_with(n_views=2.5): "n_views is to be a whole number",
    line_with(n_views=-1): "n_views is to be a whole number, not negative",
    line_with(params=2**64): "params is to be",
    line_with(seed="0"): "seed is to be",
    line_with(strategy=["ngd"]): "strategy is to be text",
    line_with(overrides="a=1"): "overrides is to be a list",
    line_with(overrides=[1]): "overrides is to be a list",
    line_with(overrides=["a=1"] * 1001): "overrides is to be a list of at most 1000",
    line_with(image_size=[1, 2, 3]): "image_size is to be a height and a width",
    line_with(scene_s=3.0): "scene_s is to be a timing",
    line_with(scene_s={"n": 1, "median": 1.0}): "scene_s is to be a timing",
    line_with(scene_s={"n": 1, "median": "x", "iqr": 0}): "scene_s is to be a timing",
    line_with(status="fine"): "status 'fine' is unknown",
    line_with(run_id=None): "no run_id",
    line_with(compile=1): "compile is to be true or false",
}


@pytest.mark.parametrize("line", DAMAGED, ids=range(len(DAMAGED)))
def test_a_line_that_is_no_row_costs_no_other_and_is_told(tmp_path, caplog, line):
    path = tmp_path / "results.jsonl"
    append_row(path, row(run_id="before"))
    with open(path, "a") as file:
        file.write(line + "\n")
    append_row(path, row(run_id="after"))
    file = RowFile(path)
    assert [r.run_id for r in file.read()] == ["before", "after"]
    assert file.skipped.lines == 1 and re.search(f"line 2: {DAMAGED[line]}", str(file.skipped))
    assert caplog.messages == [str(file.skipped)] and len(caplog.messages[0]) < 500


def test_many_lines_that_are_no_rows_are_counted_and_the_first_told(tmp_path):
    path = tmp_path / "results.jsonl"
    path.write_bytes(b"\xff\xfe\n" * 50 + line_with().encode() + b'\n{"torn')
    file = RowFile(path)
    assert len(file.read()) == 1 and file.skipped.lines == 51
    assert re.search(r"51 lines are no rows .* line 1: .*; line 52: not JSON.*; and 47 more", str(file.skipped))


def test_a_very_long_line_is_skipped_and_never_in_memory(tmp_path, monkeypatch):
    path = tmp_path / "results.jsonl"
    long = line_with(error="x" * 10_000)
    path.write_text(f"{line_with(run_id='before')}\n{long}\n{line_with(run_id='after')}\n{long}")
    assert len(read_rows(path)) == 4
    monkeypatch.setattr(rows_module, "LONGEST", 4096)
    file = RowFile(path)
    assert [r.run_id for r in file.read()] == ["before", "after"]
    assert file.skipped.lines == 2 and "line 2: longer than 4096 bytes; line 4: longer" in str(file.skipped)


def test_what_a_writer_adds_is_read_once(tmp_path, monkeypatch):
    path = tmp_path / "results.jsonl"
    append_row(path, row(run_id="1"))
    file = RowFile(path)
    (first,) = file.read()
    append_row(path, row(run_id="2"))
    parsed = []
    parse = rows_module.parse_row
    monkeypatch.setattr(rows_module, "parse_row", lambda line, words: parsed.append(line) or parse(line, words))
    assert [r.run_id for r in file.read()] == ["1", "2"] and file.rows[0] is first and len(parsed) == 1
    line = line_with(run_id="3")
    with open(path, "a") as half:  # by somebody who does not lock
        half.write(line[:50])
    assert len(file.read()) == 2 and file.skipped.lines == 1
    with open(path, "a") as half:
        half.write(line[50:])
    assert [r.run_id for r in file.read()] == ["1", "2", "3"] and file.skipped.lines == 0
    path.write_text(line_with(run_id="edited") + "\n")
    assert [r.run_id for r in file.read()] == ["edited"]


def test_what_no_file_can_hold_is_replaced(tmp_path):
    path = tmp_path / "results.jsonl"
    path.write_text(line_with(error="half \ud800 a pair, whole \U0001f600", overrides=["x=\udc00"]))
    (back,) = read_rows(path)
    assert (back.error, back.overrides) == ("half ? a pair, whole \U0001f600", ["x=?"])


def test_a_row_that_is_written_can_be_read(tmp_path):
    append_row(tmp_path / "results.jsonl", row(error="\U0001f600" * 100_000))
    (back,) = read_rows(tmp_path / "results.jsonl")
    assert back.error == "\U0001f600" * rows_module.LONGEST_ERROR


def test_a_pipe_or_a_folder_is_no_file_of_results(tmp_path):
    os.mkfifo(tmp_path / "results.jsonl")
    (tmp_path / "folder.jsonl").mkdir()
    for name in ("results", "folder"):
        with pytest.raises(DataError, match=rf"{name}\.jsonl: it is not a file"):
            read_rows(tmp_path / f"{name}.jsonl")


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(DataError, match=r"absent\.jsonl"):
        read_rows(tmp_path / "absent.jsonl")


def test_a_torn_line_does_not_swallow_the_next_row(tmp_path):
    path = tmp_path / "results.jsonl"
    append_row(path, row(run_id="before"))
    with open(path, "a") as file:
        file.write('{"schema_version": 2, "run_')
    append_row(path, row(run_id="after"))
    lines = path.read_text().splitlines()
    assert len(lines) == 3 and json.loads(lines[2])["run_id"] == "after"


def test_a_full_disk_leaves_the_file_as_it_was(tmp_path, monkeypatch):
    path = tmp_path / "results.jsonl"
    append_row(path, row())
    before = path.read_bytes()
    write = os.write
    monkeypatch.setattr(os, "write", lambda file, data: write(file, data[:20]))
    with pytest.raises(DataError, match="no space left"):
        append_row(path, row())
    assert path.read_bytes() == before


WRITER = """
import sys
from nerfdiff.results.row import ResultRow, append_row
path, name = sys.argv[1:]
for i in range(50):
    append_row(path, ResultRow(run_id=f"{name}-{i}", error="x" * 20_000))
"""


def test_four_processes_at_once_lose_and_mix_nothing(tmp_path):
    path = tmp_path / "results.jsonl"
    environment = os.environ | {"PYTHONPATH": str(SRC)}
    started = [subprocess.Popen([sys.executable, "-c", WRITER, str(path), name], env=environment) for name in "abcd"]
    assert [process.wait(timeout=60) for process in started] == [0, 0, 0, 0]
    rows = read_rows(path)
    assert {r.run_id for r in rows} == {f"{name}-{i}" for name in "abcd" for i in range(50)}
    assert len(rows) == 200 and all(r.error == "x" * 20_000 for r in rows)


def test_a_reader_waits_for_a_row_that_is_being_written(tmp_path):
    append_row(tmp_path / "one.jsonl", row())
    line, path = (tmp_path / "one.jsonl").read_text(), tmp_path / "results.jsonl"
    with open(path, "w") as file, ThreadPoolExecutor() as threads:
        fcntl.flock(file, fcntl.LOCK_EX)
        file.write(line[:100])
        file.flush()
        reading = threads.submit(read_rows, path)
        with pytest.raises(TimeoutError):
            reading.result(timeout=0.2)
        file.write(line[100:])
        file.flush()
        fcntl.flock(file, fcntl.LOCK_UN)
        assert [r.run_id for r in reading.result(timeout=60)] == ["r1"]


def test_reading_results_needs_no_pytorch():
    code = "import sys, nerfdiff.results.row; sys.exit('torch' in sys.modules)"
    subprocess.run([sys.executable, "-c", code], env=os.environ | {"PYTHONPATH": str(SRC)}, check=True)


def test_csv_has_one_scalar_per_column(tmp_path):
    rows = [row(), row(run_id="r2", encode_s=None, psnr=None)]
    flat = flatten(rows[0])
    assert flat["encode_s_n"] == 3 and flat["encode_s_median"] == 0.25 and "encode_s" not in flat
    assert flat["overrides"] == "model=tiny seed=1"
    write_csv(tmp_path / "results.csv", COLUMNS, map(flatten, rows))
    with open(tmp_path / "results.csv", newline="") as file:
        first, second = csv.DictReader(file)
    assert first["psnr"] == "21.5" and first["encode_s_iqr"] == "0.01"
    assert second["psnr"] == "" and second["encode_s_n"] == "" and second["run_id"] == "r2"
