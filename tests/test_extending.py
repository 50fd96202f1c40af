"""docs/extending.md, taken at its word: its files in an empty folder, run as its commands are."""

import csv
import re
import shlex
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from model_fixtures import look_at
from nerfdiff.checkpoint import load_model
from nerfdiff.cli import load_config
from nerfdiff.commands import chart, distill, evaluate, train
from nerfdiff.field.kinds import field_kind
from nerfdiff.metrics.table import METRICS, PACKAGE
from nerfdiff.results.row import read_rows
from nerfdiff.utils.errors import ConfigError

DOCS = Path(__file__).parents[1] / "docs" / "extending.md"
QUIET = ["hydra/job_logging=none", "hydra/hydra_logging=none"]
SIZE = 64  # ckpt=demo


@pytest.fixture(scope="module")
def own(tmp_path_factory):
    """The files of the documentation, and two scenes of each split."""
    folder = tmp_path_factory.mktemp("own")
    files = dict(re.findall(r"^`([\w/]+\.(?:py|yaml))`:\n\n```\w+\n(.*?)^```", DOCS.read_text(), re.M | re.S))
    assert len(files) == 10  # two of each kind
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    noise = np.random.default_rng(0)
    for split in ("train", "val", "test"):
        (folder / "boxes" / split).mkdir(parents=True)
        for scene in range(2):
            c2w = np.stack([look_at((side, 0.0, 0.0)).numpy() for side in (0.0, 0.2, 0.4)])
            K = np.array([[1.025 * SIZE, 0, SIZE / 2], [0, 1.025 * SIZE, SIZE / 2], [0, 0, 1]])
            images = noise.integers(0, 256, (3, SIZE, SIZE, 3), dtype=np.uint8)
            np.savez(folder / "boxes" / split / f"box{scene}.npz", images=images, c2w=c2w, K=K)
    return folder


@pytest.fixture(autouse=True)
def path_and_metrics(own, monkeypatch):
    """Modules are found in the folder; metrics that a test registers are forgotten after it."""
    before = dict(METRICS)
    monkeypatch.syspath_prepend(own)
    yield
    METRICS.clear()
    METRICS.update(before)


def run(monkeypatch, command, own: Path, out: Path, *words: str) -> None:
    """A command with its arguments, in this process."""
    data = ["data=boxes", f"data.root={own / 'boxes'}", f"data.cache_dir={own / 'cache'}", "data.num_workers=0"]
    given = [] if command is chart else [*data, "threads=1", f"paths.run_dir={out}"]
    name = command.__name__.rpartition(".")[2]
    monkeypatch.setattr(sys, "argv", [name, "--config-dir", str(own / "conf"), *given, *QUIET, *words])
    monkeypatch.setattr("nerfdiff.cli.quieten", lambda: None)  # the loggers are those of all tests
    command.main()


def test_a_dataset_a_field_a_strategy_and_a_metric_from_training_to_the_chart(own, tmp_path, monkeypatch):
    run(
        monkeypatch, train, own, tmp_path / "run",
        *("model=tiny", "field=fog", "trainer=cpu", "trainer.max_steps=2"),
        *("validation_every=2", "validation_times=[0.5]", "model.unet.channel_mult=[1,1]"),
        *("model.unet.attention_downsampling=[2]", "data.batch_size=2"),
        *("callbacks.previews=null", "callbacks.progress=null"),
    )  # fmt: skip
    assert load_model(tmp_path / "run" / "model", "ema").model.field_name == "fog"
    few = ["sheet.scenes=1", "metrics.lpips=false", "metrics.st_lpips=false", "metrics.fid=false", "baselines=false"]
    words = [f"ckpt={tmp_path / 'run'}", "strategy=dimmed", "metrics=strict", "orbit.scenes=0", *few]
    run(monkeypatch, evaluate, own, tmp_path / "out", *words)

    (row,) = read_rows(tmp_path / "out" / "results.jsonl")
    assert (row.status, row.dataset, row.field, row.strategy) == ("ok", "boxes/test", "fog", "dimmed")
    assert row.measured("absolute_error") > 0
    assert f'hydra.searchpath=["file://{own}/conf"]' in shlex.split(row.command)
    (table,) = (tmp_path / "out").rglob("table.md")
    assert "absolute error ↓" in table.read_text() and f"{row.measured('absolute_error'):.4f}" in table.read_text()
    scores = csv.DictReader((tmp_path / "out" / row.folder / "scores/dimmed/per_scene.csv").open())
    assert np.mean([float(line["absolute_error"]) for line in scores]) == pytest.approx(row.measured("absolute_error"))

    for metric in set(METRICS) - {metric.name for metric in PACKAGE}:
        del METRICS[metric]  # as in another process, which has the rows alone
    run(monkeypatch, chart, own, tmp_path, f"results={tmp_path / 'out'}", f"out={tmp_path / 'chart'}")
    assert (
        '"name":"absolute error","unit":"","better":"lower","within":0.01'
        in (tmp_path / "chart/index.html").read_text()
    )
    assert (tmp_path / "chart" / "absolute_error-scene_s.png").is_file()
    (line,) = csv.DictReader((tmp_path / "chart" / "configurations.csv").open())
    assert float(line["absolute_error"]) == pytest.approx(row.measured("absolute_error"))


def test_a_prior_where_a_field_is_fitted(own, tmp_path, monkeypatch):
    tiny = ["budget=minutes", "budget.steps=1", "budget.inner_steps=1", "budget.views=2", "budget.rays=16"]
    few = ["sheet.scenes=0", "orbit.frames=0", "data.eval_scenes=1", "metrics.st_lpips=false", "per_scene=false"]
    run(monkeypatch, distill, own, tmp_path, "ckpt=demo", "strategy=sds", "prior=arc", "weights=ema", *tiny, *few)
    (row,) = read_rows(tmp_path / "results.jsonl")
    assert (row.status, row.prior, row.K) == ("ok", "Arc", 2)


def test_a_prior_is_the_datasets_own_or_the_sphere(own):
    search = f"hydra.searchpath=['file://{own / 'conf'}']"
    for data, prior in (
        ("boxes", "Sphere"),
        ("srn_chairs", "SRNSpiral"),
        ("clevr3d", "Circle"),
        ("abo", "SceneCameras"),
    ):
        for command in ("evaluate", "distill"):
            cfg = load_config(command, ["ckpt=demo", search, f"data={data}"])
            assert cfg.prior._target_ == f"nerfdiff.distill.priors.{prior}"
    assert load_config("distill", ["ckpt=demo", "data=srn_cars", "prior.radius=2"]).prior.radius == 2


def test_what_is_wrong_with_something_of_ones_own_is_said(own, monkeypatch, tmp_path):
    with pytest.raises(ConfigError, match=r"there is no data/boxes; choices: .*srn_cars"):
        load_config("train", ["data=boxes"])
    with pytest.raises(SystemExit, match=r"--config-dir .*nowhere/conf: no such folder"):
        run(monkeypatch, train, own / "nowhere", tmp_path)
    with pytest.raises(SystemExit, match=r"strategy\.shade is not a key; did you mean strategy\.share\?"):
        run(monkeypatch, evaluate, own, tmp_path, "ckpt=demo", "strategy=dimmed", "strategy.shade=1")


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"_target_": "my_field.Fogg"}, r"_target_=my_field\.Fogg cannot be imported"),
        ({"_target_": "os.system", "command": "true"}, r"_target_=os\.system cannot be imported"),
        (
            {"_target_": "subprocess.Popen", "args": "true"},
            r"subprocess\.Popen is no nerfdiff\.field\.kinds\.FieldKind",
        ),
        ({"_target_": "my_field.Fog", "height": 3}, r"my_field\.Fog does not take these settings .*height"),
    ],
)
def test_nothing_but_a_kind_of_field_is_made_of_a_checkpoints_settings(settings, message):
    with pytest.raises(ConfigError, match=message):
        field_kind({"name": "fog"} | settings)


@pytest.mark.parametrize("name", ["demo", "demo_chairs"])
def test_models_from_before_fields_had_a_target_are_read(name):
    model = load_model(name, "ema").model
    assert model.field_name == "triplane" and all(torch.isfinite(p).all() for p in model.parameters())
