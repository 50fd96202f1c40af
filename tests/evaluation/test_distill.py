"""The command from a checkpoint and scenes, or a picture, to fields."""

import csv
import dataclasses
import io
import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys

import numpy as np
import psutil
import pytest
import torch
from hydra.utils import instantiate
from PIL import Image
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from nerfdiff.cli import load_config
from nerfdiff.distill.distillation import Distillation
from nerfdiff.distill.module import NGDModule
from nerfdiff.distill.priors import Sphere
from nerfdiff.evaluation.distill import _warn_of_unused, distill
from nerfdiff.evaluation.progress import SceneProgress
from nerfdiff.evaluation.run import dataset_run, picture_run
from nerfdiff.fit.saved_field import FIELD, load_field
from nerfdiff.metrics.predictions import read_prediction
from nerfdiff.metrics.score import Scorer
from nerfdiff.results.row import read_rows
from nerfdiff.stopping import Stopped, on_signals, stop
from nerfdiff.utils.errors import ConfigError, DataError, TimeUp
from training_fixtures import SRC, environment, evaluation_overrides

STEPS = 3


def overrides(data, run, out, *more) -> list[str]:
    if not any(word.startswith("strategy=") for word in more):
        more = ("strategy=ngd", *more)
    return evaluation_overrides(
        data,
        run,
        out,
        "budget=minutes",
        f"budget.steps={STEPS}",
        f"budget.sampler_steps={STEPS}",
        "budget.inner_steps=2",
        "budget.rays=64",
        "budget.views=3",
        "orbit.frames=3",
        "metrics.st_lpips=false",
        *more,
    )


def config(*arguments):
    return load_config("distill", overrides(*arguments))


def scene_folder(out, strategy, scene):
    (folder,) = out.glob(f"{strategy}-*/predictions/{strategy}/{scene}")
    return folder


@pytest.mark.parametrize("strategy", ["ngd", "direct", "sds", "stochastic"])
def test_every_scene_leaves_its_field_views_orbit_and_trace(strategy, data, run, tmp_path):
    row = distill(config(data, run, tmp_path, f"strategy={strategy}"))
    assert row.status == "ok" and row.n_scenes == 2 and row.fallbacks == 0 and row.psnr > 0
    assert row.K == 3 and row.prior == "SRNSpiral"
    parts = [row.denoise_s, row.fit_s, row.guide_s]
    ends = [row.encode_s, row.render_s]
    assert all(part["n"] == 1 and part["median"] > 0 for part in parts + ends)  # the first of two scenes warms up
    assert sum(part["median"] for part in parts) < row.distill_s["median"]
    rest = row.encode_s["median"] + 4 * row.render_s["median"]
    assert row.distill_s["median"] + rest == pytest.approx(row.scene_s["median"])
    assert 0 < row.timing_s < 0.01 * row.scene_s["median"]
    for scene in ("scene0", "scene1"):
        folder = scene_folder(tmp_path, strategy, scene)
        for name in (FIELD, "trace.csv", "trace.png", "orbit.mp4"):
            assert (folder / name).stat().st_size > 100, name
        assert len(list((folder / "rgb").iterdir())) == 4
        with open(folder / "trace.csv") as file:
            trace = list(csv.DictReader(file))
        assert len(trace) == STEPS and all(float(step["loss_last"]) > 0 for step in trace)
        assert [bool(step["t"]) for step in trace] == [strategy == "ngd"] * STEPS
    events = EventAccumulator(str(next((tmp_path / "tensorboard").iterdir()))).Reload()
    assert len(events.Scalars("distill/agreement")) == STEPS and len(events.Scalars("scenes/psnr")) == 2
    assert next(tmp_path.glob(f"{strategy}-*/sheet.png")).stat().st_size > 1000


@pytest.mark.parametrize(
    ("word", "steps", "why"), [("quality=draft", 2, "schedule"), ("seconds_per_scene=1e-3", 0, "deadline")]
)
def test_what_scenes_were_given_and_why_they_ended_is_written_down(word, steps, why, data, run, tmp_path):
    row = distill(config(data, run, tmp_path, word, "sheet.scenes=0", "orbit.frames=0"))
    assert (row.steps_median, row.steps_planned, row.stopped_by) == (steps, 3 if why == "deadline" else 2, f"{why} 2")
    assert row.field_queries_median * 2 == row.field_queries and row.denoiser_calls_median * 2 == row.denoiser_calls
    with open(next(tmp_path.glob("ngd-*/scores/ngd/per_scene.csv"))) as file:
        lines = list(csv.DictReader(file))
    assert [(int(line["steps"]), line["stopped_by"]) for line in lines] == [(steps, why)] * 2
    assert all(float(line["distill"]) > 0 and int(line["field_queries"]) > 0 for line in lines)
    cost = json.loads((scene_folder(tmp_path, "ngd", "scene0") / "scene.json").read_text())["cost"]
    assert (cost["steps"], cost["stopped_by"]) == (steps, why)


def test_a_deadline_that_a_strategy_cannot_keep_is_told(data, run, tmp_path, caplog):
    small = "sheet.scenes=0", "orbit.frames=0", "strategy.steps=1"
    distill(config(data, run, tmp_path, "strategy=cdm", "seconds_per_scene=5", *small))
    assert "cdm takes its time" in caplog.text


def test_k_is_the_number_of_views_that_fields_were_fitted_to(data, run, tmp_path, caplog):
    """Π of the scene's own views: the input view and 4 others, or 2 by eval_stride, whatever is asked for."""
    small = "sheet.scenes=0", "orbit.frames=0", "budget.inner_steps=1", "budget.steps=2"
    for stride, asked, used in ((1, 4, 4), (1, 9, 5), (2, 9, 3)):
        settings = "prior=abo_views", f"budget.views={asked}", f"data.eval_stride={stride}", *small
        row = distill(config(data, run, tmp_path, *settings))
        assert (row.K, row.prior) == (used, "SceneCameras")
        assert row.denoiser_calls == 2 * 2 * used  # two steps, two scenes
        sizes = [file.stat().st_size for file in (tmp_path / row.folder).rglob(FIELD)]
        assert len(sizes) == 2 and row.field_bytes == sum(sizes)
        assert (f"{used} virtual views instead of the {asked}" in caplog.text) == (used < asked)
    none = distill(config(data, run, tmp_path, "strategy=none", *small))
    assert none.K is none.prior is None and none.field_bytes > 0  # of the fields that per_scene keeps


def test_scenes_with_different_numbers_of_views_are_told(data, run, tmp_path, monkeypatch, caplog):
    """The row's K is the most; a prior needs nothing but to be called."""

    class Odd:
        def __call__(self, scene):
            return Sphere(2 if scene.scene_ids[0] == "scene0" else 3, (0.0, 20.0), (-90.0, 90.0), 20.0)(scene)

    cfg = config(data, run, tmp_path, "sheet.scenes=0", "orbit.frames=0")
    monkeypatch.setattr(
        "nerfdiff.evaluation.distill.build_strategy",
        lambda cfg: dataclasses.replace(instantiate(cfg.strategy, _convert_="all"), prior=Odd()),
    )
    row = distill(cfg)
    assert (row.K, row.prior) == (3, "Odd") and "scenes had 2 to 3 virtual views" in caplog.text


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (
            ["image=car.png", "prior=abo_views", "+data.eval_stride=2"],
            "prior=abo_views, +data.eval_stride=2 cannot act",
        ),
        (["image=car.png", "picture_views.views=3", "prior_of_mine=1"], None),
    ],
)
def test_what_cannot_act_on_a_picture_is_said(words, said, caplog):
    _warn_of_unused(words)
    assert caplog.text == "" if said is None else said in caplog.text


@pytest.mark.parametrize("precision", ["32-true", "bf16-mixed"])
def test_the_field_in_the_file_is_the_one_whose_views_were_saved(precision, data, run, tmp_path):
    cfg = config(data, run, tmp_path, f"precision={precision}", "strategy.lr_decoder=1e-2")
    distill(cfg)
    evaluation = dataset_run(cfg, torch.device("cpu"))
    cast = {name for name, value in evaluation.model.state_dict().items() if value.dtype != torch.float32}
    assert bool(cast) == (precision == "bf16-mixed") and all(name.startswith("denoiser.") for name in cast)
    (scene,) = evaluation.load(["scene1"])
    folder = scene_folder(tmp_path, "ngd", "scene1")
    saved = load_field(folder / FIELD)
    with torch.no_grad(), torch.autocast("cpu", torch.bfloat16, enabled=precision == "bf16-mixed"):
        images = saved.field.render(saved.renderer, scene.target_cameras).images[0]
    pixels = read_prediction(folder.parent, "scene1").pixels
    assert (pixels / 255 - images.float().clamp(0, 1)).abs().max() < (0.51 if precision == "32-true" else 2.0) / 255


def test_scenes_that_are_done_are_not_made_again(data, run, tmp_path, monkeypatch):
    predict, calls = Distillation.predict, []

    def stopped_at_the_second(self, model, scenes, *more):
        calls.extend(scene.scene_ids[0] for scene in scenes)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return predict(self, model, scenes, *more)

    monkeypatch.setattr(Distillation, "predict", stopped_at_the_second)
    with pytest.raises(KeyboardInterrupt):
        distill(config(data, run, tmp_path))
    row = distill(config(data, run, tmp_path))
    assert calls == ["scene0", "scene1", "scene1"] and row.n_scenes == 2


def test_a_stopped_distillation_says_what_is_saved(data, run, tmp_path, monkeypatch):
    """Within the second scene, and within Lightning's own handling of signals; no failed row."""
    step, seen = NGDModule.training_step, []

    def stopped(self, *arguments):
        seen.append(self.views[0].seed[-1])
        if len(seen) == STEPS + 2:
            os.kill(os.getpid(), signal.SIGTERM)
        return step(self, *arguments)

    monkeypatch.setattr(NGDModule, "training_step", stopped)
    with pytest.raises(Stopped, match=r"1 of 2 scenes of ngd are saved in .*predictions/ngd") as end, on_signals(stop):
        distill(config(data, run, tmp_path))
    assert end.value.status == 143 and not (tmp_path / "results.jsonl").exists()
    row = distill(config(data, run, tmp_path))
    assert row.n_scenes == 2 and seen == ["scene0"] * STEPS + ["scene1"] * (2 + STEPS)


def test_of_two_runs_side_by_side_one_appends_the_row(data, run, tmp_path, monkeypatch):
    """The second begins and ends while the first scores; a run after both has a row of its own."""
    score, nested = Scorer.score, []

    def score_while_another_runs(self, *arguments):
        if not nested:
            nested.append(True)
            nested.append(distill(config(data, run, tmp_path)))
        return score(self, *arguments)

    monkeypatch.setattr(Scorer, "score", score_while_another_runs)
    row = distill(config(data, run, tmp_path))
    assert row.run_id == nested[1].run_id and len(read_rows(tmp_path / "results.jsonl")) == 1
    distill(config(data, run, tmp_path))
    assert len(read_rows(tmp_path / "results.jsonl")) == 2


def test_a_distillation_says_how_far_it_is(data, run, tmp_path, caplog):
    caplog.set_level("INFO")
    distill(config(data, run, tmp_path, "progress_every=1e-9"))
    lines = [record.message for record in caplog.records if record.name == "nerfdiff.evaluation.progress"]
    assert re.fullmatch(r"ngd: scene 1 of 2, step 1 of 3, .* left, t 1\.00, renders against targets .* dB", lines[0])
    assert re.fullmatch(r"ngd: scene 2 of 2, step 3 of 3, .* left|ngd: scene 2 of 2, step 3 of 3, .* dB", lines[-2])
    assert re.fullmatch(r"ngd: scene 2 of 2, PSNR [\d.]+", lines[-1]) and len(lines) == 2 * (STEPS + 1)


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize(("name", "total"), [("ngd_current", 1), ("ngd_equation", 24)])
def test_the_bar_fits_a_terminal_of_80_columns(name, total, monkeypatch):
    monkeypatch.setattr(sys, "stderr", terminal := Terminal())
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setenv("TERM", "xterm")
    with SceneProgress(name, total, 60.0) as progress:
        for _ in range(total - 1):
            progress.advance("PSNR 25.11")
        (bar,) = progress.callbacks(1)
        bar.report(10 / 16, "step 10 of 16", "t 0.40, renders against targets 25.3 dB")
    line = re.sub(r"\x1b\[[\d;?]*[a-zA-Z]", "", terminal.getvalue()).strip().splitlines()[-1].rpartition("\r")[2]
    assert len(line) <= 80 and line.count("━") + line.count("╸") + line.count("╺") >= 16
    assert line.startswith(f"{name} ") and "step 10 of 16, " in line and " left" in line
    assert total == 1 or f"scene {total} of {total}" in line


def test_scenes_fitted_together_are_what_they_are_alone(data, run, tmp_path):
    pixels = {}
    for count in (1, 2):
        row = distill(config(data, run, tmp_path / str(count), f"scenes_at_once={count}"))
        assert row.status == "ok" and row.n_scenes == 2
        folder = scene_folder(tmp_path / str(count), "ngd", "scene1")
        pixels[count] = read_prediction(folder.parent, "scene1").pixels.int()
    assert (pixels[1] - pixels[2]).abs().max() <= 2
    with pytest.raises(ConfigError, match="scenes_at_once=0 must be at least 1"):
        distill(config(data, run, tmp_path / "none", "scenes_at_once=0"))


def poison(monkeypatch, *scenes: str) -> None:
    """Their second targets are not numbers."""
    fit = NGDModule._fit

    def poisoned(self, targets):
        if len(self._records) == 1:
            sick = [views.seed[-1] in scenes for views in self.views]
            targets = targets * torch.where(torch.tensor(sick), float("nan"), 1.0).reshape(-1, 1, 1, 1, 1)
        return fit(self, targets)

    monkeypatch.setattr(NGDModule, "_fit", poisoned)


def test_a_run_of_which_no_scene_is_well_diverged(data, run, tmp_path, monkeypatch):
    poison(monkeypatch, "scene0", "scene1")
    row = distill(config(data, run, tmp_path))
    assert row.status == "diverged" and row.fallbacks == 2 and row.psnr > 0


def test_a_scene_that_fell_back_says_so(data, run, tmp_path, monkeypatch):
    poison(monkeypatch, "scene1")
    row = distill(config(data, run, tmp_path))
    assert row.status == "ok" and row.fallbacks == 1 and row.error == "fell back: 1 scenes non-finite"
    with open(next(tmp_path.glob("ngd-*/scores/ngd/per_scene.csv"))) as file:
        assert {line["scene"]: line["status"] for line in csv.DictReader(file)} == {
            "scene0": "ok",
            "scene1": "non-finite",
        }
    assert load_field(scene_folder(tmp_path, "ngd", "scene1") / FIELD).field.finite().all()


def test_a_failure_is_a_row(data, run, tmp_path, monkeypatch):
    def fails(*arguments):
        raise MemoryError("no room")

    monkeypatch.setattr(Distillation, "predict", fails)
    with pytest.raises(MemoryError):
        distill(config(data, run, tmp_path))
    (row,) = read_rows(tmp_path / "results.jsonl")
    assert (row.status, row.error, row.psnr) == ("oom", "no room", None)


def test_a_run_whose_minutes_are_spent_is_a_row_and_goes_on(data, run, tmp_path):
    short = config(data, run, tmp_path, "minutes=1e-6")
    with pytest.raises(TimeUp, match=r"after 1 of 2 scenes of ngd; the same command goes on"):
        distill(short)
    (row,) = read_rows(tmp_path / "results.jsonl")
    assert row.status == "timeout" and "minutes=1e-06" in row.error and row.params > 0 and row.psnr is None
    first = scene_folder(tmp_path, "ngd", "scene0") / FIELD
    made = first.stat().st_mtime_ns
    row = distill(short)
    assert (row.status, row.n_scenes) == ("ok", 2) and first.stat().st_mtime_ns == made
    with pytest.raises(ConfigError, match="minutes=0 must be more than 0"):
        distill(config(data, run, tmp_path, "minutes=0"))


def test_a_run_that_cannot_begin_is_a_row_too(data, tmp_path):
    with pytest.raises(DataError, match="nowhere"):
        distill(config(tmp_path / "nowhere", SRC.parent / "assets" / "demo", tmp_path))
    (row,) = read_rows(tmp_path / "results.jsonl")
    assert row.status == "error" and "nowhere" in row.error and row.strategy == "ngd"


@pytest.fixture
def picture(tmp_path):
    pixels = np.zeros((40, 60, 4), np.uint8)
    pixels[10:30, 15:45] = (200, 30, 40, 255)
    path = tmp_path / "red car.png"
    Image.fromarray(pixels).save(path)
    return path


def test_equal_pictures_of_several_names_are_scenes_of_their_own(data, run, tmp_path, picture):
    other = picture.with_name("a=b, c (1).png")
    shutil.copy(picture, other)
    configs = [config(data, run, tmp_path, f"image={path}") for path in (picture, other)]
    first, second = (picture_run(cfg, torch.device("cpu")) for cfg in configs)
    assert (first.scene_ids, second.scene_ids) == (["red_car"], ["a_b_c_1"]) and first.folder != second.folder


@pytest.mark.parametrize("strategy", ["none", "cdm", "ngd"])
def test_one_picture_becomes_a_scene(strategy, data, run, tmp_path, picture):
    out = tmp_path / "out"
    more = (
        f"strategy={strategy}",
        f"image='{picture}'",
    )
    assert distill(config(data, run, out, *more)) is None
    folder = scene_folder(out, strategy, "red_car")
    facts = json.loads((folder / "scene.json").read_text())
    assert len(facts["views"]) == 3 and facts["source_views"] == ["input"]
    assert (folder / "orbit.mp4").is_file() and (folder / FIELD).is_file() == (strategy != "cdm")
    assert next(out.glob(f"{strategy}-*/sheet.png")).stat().st_size > 1000
    assert not (out / "results.jsonl").exists()


def test_two_processes_make_what_one_does(data, run, tmp_path):
    def command(out, *more):
        arguments = overrides(data, run, out, f"paths.run_dir={out}", *more)
        done = subprocess.run(
            [sys.executable, str(SRC / "distill.py"), *arguments],
            capture_output=True,
            text=True,
            env=environment(),
            timeout=300,
        )
        assert done.returncode == 0, done.stderr[-3000:]
        (row,) = read_rows(out / "results.jsonl")
        assert row.command == shlex.join(["python", "src/distill.py", *arguments])
        return [row]

    (alone,) = command(tmp_path / "one")
    (shared,) = command(tmp_path / "two", "processes=2")
    assert shared.n_scenes == 2 and shared.psnr == pytest.approx(alone.psnr, abs=1e-6)


@pytest.mark.parametrize("setting", ["processes=0", "device=cuda:7"])
def test_processes_that_cannot_be_had_are_refused(setting, data, run, tmp_path):
    with pytest.raises(ConfigError, match=setting.partition("=")[0]):
        distill(config(data, run, tmp_path, setting))


METHODS = ["none", "cdm", "ngd", "direct", "sds", "stochastic", "ngd_current", "sds_fresh"]


@pytest.mark.parametrize("strategy", [*METHODS, "ngd_sharp strategy.patch=8"])
def test_no_method_sees_the_truth(strategy, data, run, tmp_path):
    """Other target images, depths and masks: the same predictions, bit for bit."""
    cfg = config(data, run, tmp_path, *f"strategy={strategy}".split())
    evaluation = dataset_run(cfg, torch.device("cpu"))
    (scene,) = evaluation.load(["scene0"])
    other = dataclasses.replace(scene, target_pixels=255 - scene.target_pixels, target_depth=None, target_mask=None)
    first, second = (instantiate(cfg.strategy).predict(evaluation.model, [batch], 0)[0] for batch in (scene, other))
    assert torch.equal(first.images, second.images)


def test_a_process_that_dies_ends_the_run_with_a_sentence(data, run, tmp_path):
    """The other finishes its scene first; the row of the failed run says why."""
    out = tmp_path / "out"
    more = ["processes=2", "budget.steps=90", "budget.sampler_steps=90", f"paths.run_dir={out}", "progress_every=0.1"]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True, "env": environment()}
    process = subprocess.Popen([sys.executable, str(SRC / "distill.py"), *overrides(data, run, out, *more)], **pipes)
    for line in process.stdout:
        if "step " in line and " of 90" in line:  # of a fast machine not the first one is said
            (other,) = psutil.Process(process.pid).children()
            other.kill()
            break
    _, said = process.communicate(timeout=300)
    assert process.returncode == 1 and "Traceback" not in said, said
    sentence = "Process 1 of 2 was ended by SIGKILL. 1 of 2 scenes of ngd are saved in "
    assert said.strip().splitlines()[-1].startswith(f"error: {sentence}")
    (row,) = read_rows(out / "results.jsonl")
    assert row.status == "error" and row.error.startswith(sentence)


def test_a_process_that_fails_ends_the_run_with_its_words(data, run, tmp_path):
    """The first process's scene is whole, the second's cannot be written."""
    out = tmp_path / "out"
    distill(config(data, run, out))  # to know the folder
    folder = scene_folder(out, "ngd", "scene1")
    shutil.rmtree(folder)
    folder.write_text("no folder")
    done = subprocess.run(
        [sys.executable, str(SRC / "distill.py"), *overrides(data, run, out, f"paths.run_dir={out}", "processes=2")],
        capture_output=True,
        text=True,
        env=environment(),
        timeout=300,
    )
    assert done.returncode != 0
    row = read_rows(out / "results.jsonl")[-1]
    assert row.status == "error" and "process 1 of 2 failed" in row.error and "scene1" in row.error
