"""Stresses through the commands: rows, verdicts, controls of the metrics, training."""

import json
from dataclasses import replace

import numpy as np
import pytest
from omegaconf import OmegaConf
from PIL import Image

from nerfdiff.cli import load_config
from nerfdiff.evaluation.calibrate import calibrate
from nerfdiff.evaluation.controls import controls_markdown
from nerfdiff.evaluation.distill import distill
from nerfdiff.evaluation.evaluate import evaluate
from nerfdiff.results.frame import Run
from nerfdiff.results.row import read_rows
from nerfdiff.stability.breaking import Failure
from nerfdiff.stability.familiar import Familiar
from nerfdiff.stability.silent import Silent
from nerfdiff.stress.axes import stress_files
from nerfdiff.sweeps.silent_sheet import silent_sheet
from nerfdiff.training.rows import verdict
from nerfdiff.utils.errors import ConfigError
from training_fixtures import evaluation_overrides, run_training

SMALL = (
    "budget=stress", "budget.steps=2", "budget.sampler_steps=2", "budget.inner_steps=1", "budget.rays=32",
    "budget.views=2", "sheet.scenes=0", "orbit.frames=0", "metrics.st_lpips=false", "dashboard=null",
)  # fmt: skip


def config(data, run, out, *more, command="distill"):
    small = SMALL if command == "distill" else (*SMALL[:-4], "orbit.scenes=0", *SMALL[-2:], "sheet.scenes=0")
    return load_config(command, evaluation_overrides(data, run, out, *small, *more))


def rgb(out) -> list[bytes]:
    return [path.read_bytes() for path in sorted(out.glob("*/predictions/*/*/rgb/*.png"))]


def test_rows_have_axis_and_severity_and_no_severity_is_no_stress_to_the_bit(data, run, tmp_path):
    plain = distill(config(data, run, tmp_path / "plain", "strategy=none"))
    neutral = distill(config(data, run, tmp_path / "neutral", "strategy=none", "stress=focal", "stress.severity=1.0"))
    stressed = distill(config(data, run, tmp_path / "focal", "strategy=none", "stress=focal", "stress.severity=1.2"))
    assert (plain.stress, plain.severity) == (neutral.stress, neutral.severity) == (None, None)
    assert (stressed.stress, stressed.severity, stressed.neutral) == ("focal", 1.2, 1.0)
    assert plain.config_sha256 == neutral.config_sha256 != stressed.config_sha256
    assert rgb(tmp_path / "plain") == rgb(tmp_path / "neutral") != rgb(tmp_path / "focal")
    (row,) = read_rows(tmp_path / "focal" / "results.jsonl")
    assert (row.stress, row.severity, row.status) == ("focal", 1.2, "ok")


def test_a_silent_failure_is_shown_with_its_input_the_truth_and_the_view(data, run, tmp_path):
    cfg = config(
        data, run, tmp_path / "job", "strategy=none", "stress=brightness", f"results={tmp_path / 'rows.jsonl'}"
    )
    row = distill(cfg)
    (tmp_path / "job" / ".hydra").mkdir()
    OmegaConf.save(cfg, tmp_path / "job" / ".hydra" / "config.yaml")
    failure = Failure(0, "scene0", "b", 4.0, None, None, False)
    silent = Silent(stress_files()["brightness"], 0.2, "none", failure, Run(row, tmp_path))
    sheet = np.asarray(Image.open(silent_sheet(tmp_path / "silent.png", [silent]))).astype(int)
    # under a line of words, four times as large: 20 x 28 pixels
    given, truth, view = (sheet[-8 - 80 : -8, 112 * n : 112 * (n + 1)] for n in range(3))
    views = [np.asarray(Image.open(path)) for path in (tmp_path / "job").glob("*/predictions/none/scene0/rgb/*.png")]
    assert given.mean() > truth.mean() and any(np.array_equal(view[::4, ::4], each) for each in views)
    assert not any(np.array_equal(truth[::4, ::4], each) for each in views)
    assert silent_sheet(tmp_path / "none.png", [replace(silent, run=None)]) is None


@pytest.mark.parametrize("axis", ["alien_views", "elevation"])
def test_every_kind_of_stress_reaches_a_strategy(axis, data, run, tmp_path):
    """The targets, and the input view with its prior; the judge has said something of every scene."""
    # the views of these scenes are anywhere
    words = ["stress.severity=0", "stress.input_view.tolerance=90.0"] if axis == "elevation" else []
    row = distill(config(data, run, tmp_path, "strategy=direct", f"stress={axis}", *words))
    assert (row.stress, row.status, row.suspects is not None, row.verdict is not None) == (axis, "ok", True, True)
    assert (1 if axis == "views" else 2) == row.K
    for path in tmp_path.glob("*/predictions/direct/*/scene.json"):
        facts = json.loads(path.read_text())
        assert facts["verdict"] and facts["signs"]["input_psnr"] > 0 and "moved" in facts["signs"]
    scores = next(tmp_path.glob("*/scores/direct/per_scene.csv")).read_text().splitlines()
    assert scores[0].startswith("scene,views,status,verdict,blank,")


def test_evaluate_takes_stresses_too_and_a_failed_run_has_its_stress(data, run, tmp_path):
    row = evaluate(config(data, run, tmp_path, "strategy=none", "stress=occlusion", command="evaluate"))[0]
    assert (row.stress, row.severity) == ("occlusion", 0.2)
    with pytest.raises(ConfigError, match="two scenes"):
        distill(config(data, run, tmp_path, "strategy=ngd", "stress=alien_views", "data.eval_scenes=1"))
    failed = read_rows(tmp_path / "results.jsonl")[-1]
    assert (failed.status, failed.stress, failed.severity) == ("error", "alien_views", 0.1)


def test_baselines_are_strategies(data, run, tmp_path):
    small = [config(data, run, tmp_path, f"strategy={name}") for name in ("copy_input", "mean_image")]
    rows = [distill(cfg) for cfg in small]
    assert [row.strategy for row in rows] == ["copy_input", "mean_image"] and all(row.psnr > 0 for row in rows)


def test_controls_say_what_the_metrics_say_of_failures(data, tmp_path, capsys):
    words = ["part=controls", f"data.root={data}", "data.source_view=0", "data.num_workers=0", "first_scenes=2"]
    off = ["metrics.st_lpips=false", "metrics.fid=false", "metrics.lpips=false", "metrics.geometry.floater_views=1"]
    calibrate(load_config("calibrate", [*words, *off, f"out={tmp_path / 'controls.md'}"]))
    text = (tmp_path / "controls.md").read_text()
    assert text in capsys.readouterr().out
    lines = {line.split(" | ")[0].strip("| "): line.split(" | ")[1:] for line in text.splitlines()[2:]}
    assert list(lines) == ["truth", "noise", "one image repeated", "alien views", "white", "blur"]
    psnr = {kind: float(cells[0]) for kind, cells in lines.items()}
    assert psnr["truth"] == 60 and psnr["noise"] < min(psnr[kind] for kind in lines if kind != "noise")
    assert psnr["alien views"] > psnr["one image repeated"]
    shown = controls_markdown({"truth": {"psnr": 60.0} | dict.fromkeys(("ssim", "lpips", "st_lpips_vgg", "fid"))
                               | dict.fromkeys(("fd_st_vgg", "sharpness", "consistency_psnr"))})  # fmt: skip
    assert "| truth | 60.00 |" in shown


def test_a_models_training_images_are_learnt_and_other_parts_are_refused(data, run, tmp_path):
    words = [f"data.root={data}", f"ckpt={run}", "images=12", "kept=3", f"out={tmp_path / 'familiar.safetensors'}"]
    calibrate(load_config("calibrate", ["part=familiar", "data.image_size=[10,14]", *words]))
    assert Familiar.load(tmp_path / "familiar.safetensors").axes.shape[1] == 3
    for words, message in ((["part=tea"], "choose controls, familiar, judge"), (["part=judge"], "needs results=")):
        with pytest.raises(ConfigError, match=message):
            calibrate(load_config("calibrate", words))


def test_a_training_run_leaves_a_row_of_how_it_went(data, tmp_path):
    stress, severity = "train_swapped_images", 0.2
    words = [f"stress={stress}", f"stress.severity={severity}", f"results={tmp_path / 'results.jsonl'}"]
    run_training(data, tmp_path / "run", "trainer.max_steps=3", "validation_every=3", *words)
    (row,) = read_rows(tmp_path / "results.jsonl")
    assert (row.stress, row.severity, row.status, row.strategy) == (stress, severity, "ok", "training")
    assert (
        row.psnr > 0
        and row.held_out_loss > 0
        and row.nonfinite_grad_steps == 0
        and row.grad_norm_p99 > 0
        and row.dataset.endswith("/val")
    )


@pytest.mark.parametrize(
    ("psnr", "said"), [(12.6, "suspect: held-out renderings have 12.6 dB, pictures of one even"), (13.5, "ok")]
)
def test_a_training_that_collapsed_is_suspect(psnr, said):
    assert verdict({"val/psnr": psnr, "val/psnr_even": 13.1}).startswith(said) and verdict({}) is None


def test_a_training_run_that_fails_is_a_row(data, tmp_path):
    words = ["stress=train_lr", "stress.severity=3.0", f"results={tmp_path / 'results.jsonl'}", "init=nowhere"]
    with pytest.raises(Exception, match="nowhere"):
        run_training(data, tmp_path / "run", *words)
    (row,) = read_rows(tmp_path / "results.jsonl")
    assert row.status == "error" and "nowhere" in row.error and row.stress == "train_lr"
    with pytest.raises(ConfigError, match=r"of distill\.py"):
        run_training(data, tmp_path / "other", "stress=focal")
