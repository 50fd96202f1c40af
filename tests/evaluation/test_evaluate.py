import json
import os
import shutil

import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from nerfdiff.checkpoint import export, load_model
from nerfdiff.cli import load_config
from nerfdiff.distill.none import SingleImageNeRF
from nerfdiff.evaluation.evaluate import evaluate
from nerfdiff.metrics.predictions import NonFinitePrediction
from nerfdiff.results.row import read_rows
from nerfdiff.utils.errors import CheckpointError, ConfigError, DataError
from training_fixtures import evaluation_overrides


def config(data, run, out, *more):
    overrides = evaluation_overrides(
        data,
        run,
        out,
        "orbit.frames=4",
        "metrics.st_lpips=false",  # of every image of every row: only where it is looked at
        *more,
    )
    return load_config("evaluate", overrides)


@pytest.mark.parametrize("strategy", [["strategy=none"], ["strategy=cdm", "strategy.steps=3"]])
def test_an_evaluation_leaves_rows_scores_and_pictures(data, run, tmp_path, strategy):
    rows = evaluate(config(data, run, tmp_path, "metrics.st_lpips=true", *strategy))
    name = rows[0].strategy
    assert [row.strategy for row in rows] == [name, "copy_input", "mean_image"]
    assert [row.strategy for row in read_rows(tmp_path / "results.jsonl")] == [row.strategy for row in rows]
    assert rows[1].scene_s is rows[1].model is rows[1].backend is rows[1].grad_norm_p99 is None
    assert rows[0].verdict is not None and rows[1].verdict is rows[2].verdict is None  # no model made baselines
    for row in rows:
        assert row.status == "ok" and row.n_scenes == 2 and row.n_views == 2 * 4
        assert 0 < row.psnr < 60 and row.ssim_impl == "skimage-uniform7" and row.st_lpips_vgg > 0
    (folder,) = tmp_path.glob(f"{name}-*")
    for row in rows:
        assert (folder / "scores" / row.strategy / "per_image.csv").is_file()
        assert (folder / "scores" / row.strategy / "per_scene.csv").is_file()
        assert row.image_size == [20, 28]
    assert (folder / "sheet.png").stat().st_size > 1000
    assert (folder / "orbit.mp4").stat().st_size > 500
    assert name in (folder / "table.md").read_text()
    runs = {path.parent.relative_to(tmp_path / "tensorboard").as_posix() for path in tmp_path.rglob("events.*")}
    assert runs == {name, "copy_input", "mean_image"}
    events = EventAccumulator(str(tmp_path / "tensorboard" / name)).Reload()
    assert events.Scalars("accuracy/1_psnr")[0].value == pytest.approx(rows[0].psnr)
    assert events.Images("accuracy/pictures") and len(events.Scalars("scenes/psnr")) == 2
    assert len({row.run_id for row in rows}) == 3


def test_costs_are_counted(data, run, tmp_path):
    none = evaluate(config(data, run, tmp_path, "baselines=false"))[0]
    cdm = evaluate(config(data, run, tmp_path, "baselines=false", "strategy=cdm", "strategy.steps=3"))[0]
    pixels = 8 * 20 * 28
    assert none.field_queries == cdm.field_queries == pixels * 8  # 4 + 4 samples per ray
    assert (none.denoiser_calls, cdm.denoiser_calls) == (0, 8 * 3)
    assert none.distill_s is None and cdm.distill_s["n"] == 1
    assert none.depth_rmse is not None and none.mask_iou is not None
    assert none.params == cdm.params > 100_000
    assert none.scene_s["n"] == 1 and none.denoise_s is None
    rest = cdm.scene_s["median"] - cdm.distill_s["median"]
    assert rest == pytest.approx(cdm.encode_s["median"]) and cdm.fit_s is None
    assert 0 < cdm.guide_s["median"] + cdm.denoise_s["median"] < cdm.distill_s["median"]
    assert (none.model, none.field, none.samples_per_ray) == ("tiny", "triplane", 8)
    assert (none.backend, none.compile, none.scenes_at_once) == ("cpu", False, 1)
    assert none.nonfinite_grad_steps == 0 and none.grad_norm_p99 > 0  # of the training run
    assert none.encode_s["n"] == none.render_s["n"] == cdm.encode_s["n"] == 1  # the first of two scenes warms up
    assert none.encode_s["median"] + 4 * none.render_s["median"] < none.scene_s["median"] and cdm.render_s is None
    for row in (none, cdm):  # what clocks take of a scene
        assert 0 < row.timing_s < 0.01 * row.scene_s["median"]


def test_copying_the_input_scores_what_the_files_say(data, run, tmp_path):
    """PSNR of the baseline, computed from the PNG files alone."""
    import numpy as np
    from PIL import Image

    checkpoint = torch.load(run / "checkpoints" / "last.ckpt", weights_only=True)
    torch.save(checkpoint | {"image_size": None}, tmp_path / "any_size.ckpt")
    rows = evaluate(config(data, tmp_path / "any_size.ckpt", tmp_path, "data.image_size=null"))
    scenes = []
    for scene in sorted((data / "cars_test").iterdir()):
        views = [np.asarray(Image.open(p), float) / 255 for p in sorted((scene / "rgb").iterdir())]
        scenes.append(np.mean([-10 * np.log10(max(np.mean((view - views[0]) ** 2), 1e-6)) for view in views[1:]]))
    assert rows[1].psnr == pytest.approx(np.mean(scenes), abs=1e-4)


@pytest.mark.parametrize("left", ["nothing", "an empty folder"])
def test_a_test_split_alone_is_evaluated_without_the_mean_image(data, run, tmp_path, caplog, left):
    shutil.copytree(data / "cars_test", tmp_path / "data" / "cars_test")
    if left == "an empty folder":
        (tmp_path / "data" / "cars_train").mkdir()
    settings = "orbit.scenes=0", "metrics.st_lpips=false"
    rows = evaluate(config(tmp_path / "data", run, tmp_path / "out", *settings))
    assert [row.strategy for row in rows] == ["none", "copy_input"] and all(row.status == "ok" for row in rows)
    assert sum("mean_image is left out" in message and "train" in message for message in caplog.messages) == 1
    (tmp_path / "data" / "cars_train" / "scene0").mkdir(parents=True)  # a damaged one is no missing one
    with pytest.raises(DataError, match=r"scene0/rgb: no such folder"):
        evaluate(config(tmp_path / "data", run, tmp_path / "out", *settings))


def test_the_same_evaluation_predicts_nothing_twice(data, run, tmp_path, monkeypatch):
    first = evaluate(config(data, run, tmp_path))

    def never(*arguments):
        raise AssertionError("predicted again")

    video = config(data, run, tmp_path, "orbit.scenes=0")
    monkeypatch.setattr(SingleImageNeRF, "predict", never)
    again = evaluate(video)
    assert [row.psnr for row in again] == [row.psnr for row in first]


def test_seconds_of_other_conditions_are_not_counted(data, run, tmp_path, monkeypatch):
    """Numbers are of all scenes, whenever they were predicted; seconds of those predicted under the row's settings."""
    settings = "orbit.scenes=0", "baselines=false"
    (alone,) = evaluate(config(data, run, tmp_path, *settings))
    (together,) = evaluate(config(data, run, tmp_path, *settings, "scenes_at_once=2"))
    assert together.folder == alone.folder and together.psnr == alone.psnr
    assert together.scene_s is together.render_s is together.peak_mem_bytes is None
    assert together.config_sha256 != alone.config_sha256
    (otherwise,) = evaluate(config(data, run, tmp_path, *settings, "backend=torch"))
    assert otherwise.folder != alone.folder and otherwise.backend == "torch" and otherwise.scene_s["n"] == 1


def test_a_killed_evaluation_goes_on_at_the_next_scene(data, run, tmp_path, monkeypatch):
    predict, calls = SingleImageNeRF.predict, []

    def fail_at_the_second(self, model, scenes, *more):
        calls.extend(scene.scene_ids[0] for scene in scenes)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return predict(self, model, scenes, *more)

    monkeypatch.setattr(SingleImageNeRF, "predict", fail_at_the_second)
    settings = config(data, run, tmp_path, "orbit.scenes=0")
    with pytest.raises(KeyboardInterrupt):
        evaluate(settings)
    rows = evaluate(settings)
    assert calls == ["scene0", "scene1", "scene1"]
    assert rows[0].n_scenes == 2


def test_a_failure_is_a_row(data, run, tmp_path, monkeypatch):
    predict = SingleImageNeRF.predict

    def broken(self, *arguments):
        (views,) = predict(self, *arguments)
        views.images[0, 0, 0, 0] = float("nan")
        return [views]

    monkeypatch.setattr(SingleImageNeRF, "predict", broken)
    with pytest.raises(NonFinitePrediction):
        evaluate(config(data, run, tmp_path))
    row = read_rows(tmp_path / "results.jsonl")[-1]
    assert row.status == "nan" and "not finite" in row.error and row.psnr is None


def test_an_all_white_scene_is_finite_and_reported(data, run, tmp_path):
    from PIL import Image

    shutil.copytree(data, tmp_path / "data", ignore=shutil.ignore_patterns("cache"))
    white = sorted((tmp_path / "data" / "cars_test").iterdir())[0]
    for path in (white / "rgb").iterdir():
        Image.new("RGB", Image.open(path).size, "white").save(path)
    rows = evaluate(config(tmp_path / "data", run, tmp_path / "out", "metrics.st_lpips=true"))
    copy = rows[1]
    assert copy.blank_scenes == 1
    assert copy.psnr == pytest.approx((60 + copy.psnr_without_blank) / 2, abs=1e-3)
    assert all(torch.isfinite(torch.tensor([row.psnr, row.ssim, row.st_lpips_vgg])).all() for row in rows)


def test_missing_checkpoints_and_data_are_named(data, run, tmp_path):
    with pytest.raises(CheckpointError, match="ckpt=nothing is neither"):
        evaluate(config(data, "nothing", tmp_path))
    with pytest.raises(DataError, match="nowhere"):
        evaluate(config(tmp_path / "nowhere", run, tmp_path))


def test_another_resolution_than_in_training_is_named(data, run, tmp_path):
    with pytest.raises(ConfigError, match=r"set data\.image_size=\[20,28\]"):
        evaluate(config(data, run, tmp_path, "data.image_size=null"))


@pytest.mark.parametrize(
    ("setting", "word"),
    [
        ("device=cuda:7", "device=auto"),
        ("precision=16", "bf16-mixed"),
        ("kernel_precision=fp8", "kernel_precision='fp8': choose auto, ieee"),
    ],
)
def test_what_this_machine_cannot_do_is_said(data, run, tmp_path, setting, word):
    with pytest.raises(ConfigError, match=word):
        evaluate(config(data, run, tmp_path, setting))


def test_weights_can_be_shared_at_half_the_size(run, tmp_path):
    umask = os.umask(0o027)
    whole = export(str(run), "ema", tmp_path / "whole", "float32", tmp_path)
    os.umask(umask)
    assert [path.stat().st_mode & 0o777 for path in whole.parent.iterdir()] == [0o640, 0o640]
    half = export(str(run), "ema", tmp_path / "half", "float16", tmp_path)
    assert half.stat().st_size < 0.6 * whole.stat().st_size
    first, second = (load_model(path.parent, "ema", tmp_path).model.state_dict() for path in (whole, half))
    assert all(torch.allclose(first[name], second[name], rtol=1e-3, atol=1e-4) for name in first)
    with pytest.raises(ConfigError, match="float32, bfloat16, float16"):
        export(str(run), "ema", tmp_path / "bad", "int8", tmp_path)


def test_samples_do_not_depend_on_what_is_sampled_beside_them(data, run, tmp_path):
    more = ("baselines=false", "orbit.scenes=0", "strategy=cdm", "strategy.steps=3", "strategy.eta=1.0")
    together = evaluate(config(data, run, tmp_path / "a", *more))[0]
    apart = evaluate(config(data, run, tmp_path / "b", *more, "strategy.views_at_once=1"))[0]
    assert apart.psnr == pytest.approx(together.psnr, abs=1e-3)


def test_files_that_are_no_checkpoints_are_refused(tmp_path):
    for name, content in {"a.ckpt": b"nonsense", "b.safetensors": b"\0" * 64}.items():
        (tmp_path / name).write_bytes(content)
        (tmp_path / "model.yaml").write_text("{weights: ema, image_size: null, model: {}}")
        with pytest.raises(CheckpointError, match=name):
            load_model(tmp_path / name, "ema", tmp_path)
    torch.save({"state_dict": {}}, tmp_path / "c.ckpt")
    with pytest.raises(CheckpointError, match="holds no model settings"):
        load_model(tmp_path / "c.ckpt", "ema", tmp_path)


def test_a_checkpoint_never_runs_code(tmp_path):
    class Evil:
        def __reduce__(self):
            return (open, (str(tmp_path / "written"), "w"))

    torch.save({"state_dict": Evil()}, tmp_path / "evil.ckpt")
    with pytest.raises(CheckpointError, match=r"evil\.ckpt"):
        load_model(tmp_path / "evil.ckpt", "ema", tmp_path)
    assert not (tmp_path / "written").exists()


def test_predictions_name_their_source_view(data, run, tmp_path):
    evaluate(config(data, run, tmp_path, "baselines=false"))
    (scene,) = tmp_path.glob("none-*/predictions/none/scene0/scene.json")
    assert json.loads(scene.read_text())["source_views"] == ["000000"]


def test_samples_per_ray_can_be_other_ones_than_in_training(data, run, tmp_path):
    settings = ["baselines=false", "orbit.scenes=0", "sheet.scenes=0"]
    asked = ["uniform_samples=2", "importance_samples=3"]
    few, trained = (evaluate(config(data, run, tmp_path, *settings, *more))[0] for more in (asked, []))
    assert (few.samples_per_ray, trained.samples_per_ray) == (5, 8)
    assert few.field_queries * 8 == trained.field_queries * 5 > 0 and few.psnr != trained.psnr
    assert few.folder != trained.folder and few.config_sha256 != trained.config_sha256
    with pytest.raises(ConfigError, match="importance_samples=0 must be at least 1"):
        evaluate(config(data, run, tmp_path, *settings, "importance_samples=0"))
