"""Sweeps of conf/sweep as commands, their tables included."""

import csv
import subprocess
import sys

import pytest
from hydra import compose, initialize_config_dir
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf
from PIL import Image

from nerfdiff.cli import CONF, check_overrides
from nerfdiff.results.row import read_rows
from nerfdiff.sweeps.jobs import group, jobs_of
from nerfdiff.utils.errors import ConfigError
from training_fixtures import SRC, environment, run_training, write_dataset

OURS = ("shards", "speed_accuracy", "stability")
SWEEPS = sorted(path.stem for path in (CONF / "sweep").glob("*.yaml") if path.stem not in OURS)
"""Of Hydra's own sweeper; ours is tested beside this file."""


def composed(*overrides):
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return compose("distill", ["ckpt=demo", *overrides], return_hydra_config=True)


@pytest.fixture(params=SWEEPS)
def sweep(request, tmp_path):
    return composed(f"sweep={request.param}", f"hydra.sweep.dir={tmp_path}")


def test_the_labels_that_a_sweep_names_are_labels_of_its_jobs(sweep):
    table = sweep.hydra.callbacks.table
    labels = [g.labels for g in group(jobs_of(sweep), list(table.labels))]
    assert len(labels) > 4
    for wanted in [table.reference, table.goal, *(entry.of for entry in table.paper)]:
        wanted = {key: str(value) for key, value in wanted.items()}
        assert any(wanted.items() <= found.items() for found in labels), wanted


@pytest.mark.parametrize(("name", "key"), [("guidance", "strategy.teacher.guidance"), ("switches", "strategy.teacher")])
def test_choices_replace_keys_that_there_are_and_keep_the_others(name, key):
    parser = OverridesParser.create()
    (override,) = parser.parse_overrides([f"{key}={composed(f'sweep={name}').hydra.sweeper.params[key]}"])
    choices = list(override.sweep_string_iterator())

    def raw(config):
        return OmegaConf.to_container(config, resolve=False)

    before = OmegaConf.select(composed("strategy=ngd"), key)
    values = [parser.parse_overrides([f"{key}={choice}"])[0].value() for choice in choices]
    after = [raw(OmegaConf.merge(raw(before), value)) for value in values]
    merged = OmegaConf.select(composed("strategy=ngd", f"{key}={choices[-1]}"), key)
    assert raw(merged) == after[-1]  # Hydra merges as well
    assert all(found.keys() == raw(before).keys() for found in after)
    assert len({str(found) for found in after}) == len(choices)


def test_a_sweep_can_be_left_out_but_not_misspelt():
    assert composed().hydra.mode is None or composed().hydra.mode.name == "RUN"
    with pytest.raises(ConfigError, match=r"strategies"):
        check_overrides("distill", ["sweep=strategy"])
    with pytest.raises(ConfigError, match="~sweep"):
        check_overrides("distill", ["sweep=null"])


def test_a_sweep_ends_in_a_table_though_jobs_fail(tmp_path):
    data = write_dataset(tmp_path / "data", scenes=1)
    run_training(data, tmp_path / "runs" / "conditioning_rendered", "trainer.max_steps=1", "data.image_size=[20,28]")
    command = [
        sys.executable, str(SRC / "distill.py"), "sweep=conditioning", "cdm=concat,rendered", "seed=0",
        f"paths.runs_dir={tmp_path / 'runs'}", f"data.root={data}", "data.cache=false", "data.image_size=[20,28]",
        "data.source_view=0", "data.num_workers=0", "data.eval_stride=2", "budget=minutes", "budget.steps=1",
        "budget.sampler_steps=1", "budget.inner_steps=1", "budget.rays=1", "budget.views=2",
        "orbit.frames=0", "sheet.scenes=1", "metrics.st_lpips=false",
        "threads=1",
    ]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, env=environment(), timeout=300)
    assert done.returncode == 0 and "the sweep's table" not in done.stdout, (done.stdout + done.stderr)[-3000:]
    folder = tmp_path / "runs" / "sweeps" / "conditioning" / "srn_cars"
    assert [row.status for row in read_rows(folder / "results.jsonl")] == ["error", "error", "ok", "ok"]
    rows = list(csv.DictReader((folder / "table.csv").open()))
    assert [(row["cdm"], row["strategy"], row["status"]) for row in rows] == [
        ("concat", "none", "error"),
        ("concat", "ngd", "error"),
        ("rendered", "none", "ok"),
        ("rendered", "ngd", "ok"),
    ]
    assert "conditioning_concat is neither" in rows[0]["error"]
    assert rows[3]["paper_psnr"] == "23.51" and float(rows[3]["psnr"]) > 0
    none, ngd = (row for row in read_rows(folder / "results.jsonl") if row.status == "ok")
    assert float(rows[3]["psnr_difference"]) == pytest.approx(ngd.psnr - none.psnr, abs=1e-5)
    assert "| rendered | ngd |" in (folder / "table.md").read_text()
    assert Image.open(folder / "grid.png").width > 4 * 128  # input, truth, none, ngd
    assert "conditioning_concat is neither" in done.stdout and str(folder / "table.md") in done.stdout


def test_a_job_that_fails_does_not_end_those_after_it(tmp_path):
    script = tmp_path / "command.py"
    script.write_text(
        "from nerfdiff.cli import entry_point\n"
        "from nerfdiff.utils.errors import DataError\n"
        "@entry_point('inspect_data')\n"
        "def main(cfg):\n"
        "    if cfg.data.eval_stride == 1:\n"
        "        raise DataError('a fault')\n"
        "    print('done', cfg.data.eval_stride)\n"
        "main()\n"
    )
    command = [sys.executable, str(script), "-m", "data.eval_stride=1,2", f"hydra.sweep.dir={tmp_path}"]
    done = subprocess.run(command, capture_output=True, text=True, env=environment(), timeout=60)
    assert "done 2" in done.stdout and done.returncode == 1
    assert "error: a fault" in done.stderr and "Traceback" not in done.stderr
