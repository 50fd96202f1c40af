import csv
import fcntl
import json
import math
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from nerfdiff.errors import DataError
from nerfdiff.results.row import ResultRow, append_row, flatten, read_rows, write_rows_csv

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
    assert vars(row()).keys() >= CONTRACT


def test_unknown_status_is_refused():
    with pytest.raises(ValueError, match="'fine' is unknown; choose one of ok, nan, oom"):
        row(status="fine")


def test_rows_of_another_schema_version_are_refused(tmp_path):
    path = tmp_path / "results.jsonl"
    append_row(path, row())
    append_row(path, row(schema_version=1))
    with pytest.raises(DataError, match=r"results\.jsonl, line 2: schema version 1, this program reads 2"):
        read_rows(path)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ('{"schema_version": 2, "run', "line 1: not JSON"),
        ("[1]", "schema version None"),
        ('{"schema_version": 2, "run_id": "x", "psnrr": 3}', "unknown fields psnrr"),
        ('{"schema_version": 2}', "run_id"),
    ],
)
def test_damaged_lines_are_named(tmp_path, line, message):
    (tmp_path / "results.jsonl").write_text(line + "\n")
    with pytest.raises(DataError, match=message):
        read_rows(tmp_path / "results.jsonl")


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
    write_rows_csv(tmp_path / "results.csv", rows)
    with open(tmp_path / "results.csv", newline="") as file:
        first, second = csv.DictReader(file)
    assert first["psnr"] == "21.5" and first["encode_s_iqr"] == "0.01"
    assert second["psnr"] == "" and second["encode_s_n"] == "" and second["run_id"] == "r2"
