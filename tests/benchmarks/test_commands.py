"""Every benchmark as a command, at a size of seconds: what it writes, never how long it took."""

import json
import math
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

import all as all_of_them
import field_speed
import harness
import inner_step
import ngd_object
import render
import training_step
import unet
from nerfdiff.distill.distillation import Distillation
from nerfdiff.utils.errors import ConfigError

TOY = ["--size", "16", "--seconds", "0.001", "--device", "cpu", "--precision", "32-true"]
SMALL = ["model.unet.channel_mult=[1,2]", "model.render.uniform_samples=4", "model.render.importance_samples=4"]


def run(command, out, *words) -> dict:
    path = Path(command.main([*SMALL, *TOY, "--out", str(out), *words]))
    assert path.parent == out
    content = json.loads(path.read_text())
    assert content["complete"] and not list(out.glob("*.partial.json"))
    assert content["benchmark"] == command.__name__ and content["model"] == "tiny" and content["image_size"] == [16, 16]
    assert content["limits"]["copy"] > 0 and content["limits"]["matrix"] > 0
    for row in content["rows"]:
        assert (row["seconds"] is None) == (row["reason"] is not None)
        if row["seconds"]:
            assert row["seconds"]["median"] > 0 and row["work"]["flops"] > 0 and row["share_of_matrix_rate"] > 0
    return content


def ran(content) -> dict[str, dict]:
    return {row["name"]: row for row in content["rows"] if row["seconds"]}


@pytest.mark.skipif(torch.cuda.is_available(), reason="checks what a machine without a GPU says")
def test_render_times_each_backend_in_all_ways(tmp_path, capsys):
    content = run(render, tmp_path, "--rays", "32")
    ways = ("torch", "CPU field")
    assert ran(content).keys() == {f"{way}, {what}" for way in ways for what in render.WAYS}
    assert "CPU field, one view: " in capsys.readouterr().out
    assert {row["reason"] for row in content["rows"]} == {None, "needs a CUDA GPU"}
    assert content["settings"] == {"rays": 32, "samples": 8, "plane": 16, "scenes": 1}
    view, forward, both, _ = (ran(content)[f"torch, {what}"] for what in render.WAYS)
    assert view["setting"]["rays"] == 16**2 and forward["setting"]["rays"] == 32
    assert both["work"]["flops"] == 3 * forward["work"]["flops"] and forward["ratio"] == 1


@pytest.mark.parametrize("sweep", render.SWEEPS)
def test_render_makes_scaling_curves(sweep, tmp_path):
    content = run(render, tmp_path, "--rays", "32", "--sweep", sweep, "--values", "4", "8")
    assert content["sweep"] == sweep and [path.suffix for path in sorted(tmp_path.iterdir())] == [".json", ".png"]
    rows = [row for row in content["rows"] if row["name"] == "torch, forward"]
    assert [row["setting"][sweep] for row in rows] == [4, 8]
    flops = [row["work"]["flops"] for row in rows]
    assert flops[1] == (flops[0] if sweep == "plane" else 2 * flops[0])


def test_inner_step_times_a_step_of_several_scenes(tmp_path):
    words = ["--rays", "16", "--views", "2", "--steps", "2", "--sweep", "scenes", "--values", "1", "2"]
    content = run(inner_step, tmp_path, *words)
    one, two = (row for row in content["rows"] if row["name"] == "torch")
    assert "torch, coarse kept" in ran(content)
    assert two["work"]["bytes"] == 2 * one["work"]["bytes"]
    assert two["more"]["steps/s, all scenes"] == pytest.approx(2 / two["seconds"]["median"])


def test_unet_times_encoder_and_denoiser(tmp_path):
    content = run(unet, tmp_path, "--views", "2")
    assert {name.split(",")[0] for name in ran(content)} == {"encoder", "CDM"}
    assert ran(content)["CDM, eager"]["setting"] == {"views": 2}


def test_ngd_object_times_an_object_and_its_parts(tmp_path):
    budget = ["--sweep", "views", "--values", "2", "--steps", "2"]
    fewer = ["--with", "strategy.coarse=refresh", "budget.steps=2", "budget.inner_steps=1"]
    content = run(ngd_object, tmp_path, *budget, "--extrapolate", *fewer)
    assert content["settings"]["fast"] == " ".join(fewer[1:]) and content["settings"]["overrides"] == " ".join(SMALL)
    rows, steps = ran(content), content["settings"]["steps"]
    whole = rows["object, reference"]
    assert whole["more"]["extrapolated from steps"] == 2 and f"2 of {steps}" in content["notes"][0]
    assert whole["more"]["objects/min"] == pytest.approx(60 / whole["seconds"]["median"])
    parts = {name.rpartition(", ")[0]: row for name, row in rows.items() if name.endswith("reference")}
    once = parts["encode"]["work"]["flops"] + parts["conditions"]["work"]["flops"]
    each = sum(parts[part]["work"]["flops"] for part in ("denoise K views", "render K views", "N inner steps"))
    assert whole["work"]["flops"] == pytest.approx(once + steps * each)
    fast, fitted = rows["object, fast"], rows["N inner steps, fast"]["work"]["flops"]
    each += fitted - parts["N inner steps"]["work"]["flops"]
    assert fast["work"]["flops"] == pytest.approx(once + 2 * each)
    assert "extrapolated from steps" not in fast["more"]
    assert fast["ratio"] == pytest.approx(whole["seconds"]["median"] / fast["seconds"]["median"])
    assert "encode, fast" not in rows  # it is the same


def test_what_is_timed_in_part_is_said(tmp_path, monkeypatch):
    distil, made = Distillation.distil, []
    monkeypatch.setattr(
        Distillation, "distil", lambda own, *a: made.append((own.fit.coarse, own.fit.cuda_graphs)) or distil(own, *a)
    )
    words = ["--sweep", "scenes", "--values", "2", "--steps", "1", "--whole", "--few", "--strategy", "sds"]
    content = run(ngd_object, tmp_path, *words)
    assert set(made) == {("every_step", False), ("every_step", True), ("refresh", True)}
    assert len(content["rows"]) == 3 and "2 objects, fast" in ran(content)
    assert content["notes"][0].startswith("PARTIAL: objects are of 1 diffusion steps")
    row = ran(content)["2 objects, reference"]
    assert row["more"]["s/object"] == pytest.approx(row["seconds"]["median"] / 2)
    assert "extrapolated from steps" not in row["more"]


@pytest.mark.parametrize(("budget", "steps", "asked"), [("minutes", 16, (10, 16)), ("fast", 16, (8, 8))])
def test_steps_that_are_left_out_count_as_no_work(budget, steps, asked):
    """w = 1 for t of 0.681 and more; of extrapolated steps none is left out."""
    arguments = SimpleNamespace(strategy="ngd_equation", budget=budget, steps=None)
    assert ngd_object.Plan.of(arguments, ()).asked(steps) == asked
    arguments.steps = 4
    part = ngd_object.Plan.of(arguments, ())
    assert part.asked(steps) == (steps, steps) and part.method(4).teacher.keywords["at_full_guidance"] == "everything"


def test_extrapolating_asks_for_what_it_needs():
    for words in (["--extrapolate"], ["--extrapolate", "--steps", "1"]):
        with pytest.raises(SystemExit):
            ngd_object.main(words)
    # as many full evaluations of the CDM as there will be, by the share of the steps
    with pytest.raises(ConfigError, match="multiple of 4"):
        ngd_object.main([*SMALL, *TOY, "--extrapolate", "--steps", "6", "--with", "budget.deep_every=2"])
    with pytest.raises(ConfigError, match="same views"):
        ngd_object.main([*SMALL, *TOY, "--with", "budget.views=3"])


@pytest.mark.parametrize(("command", "groups"), [(render, 1), (ngd_object, 2)])
def test_what_was_measured_before_a_benchmark_is_stopped_is_in_its_file(command, groups, tmp_path, monkeypatch):
    interleaved, measured = command.interleaved, []

    def stopped(*args):
        if len(measured) == groups:
            raise KeyboardInterrupt
        measured.append(interleaved(*args))
        return measured[-1]

    monkeypatch.setattr(command, "interleaved", stopped)
    with pytest.raises(KeyboardInterrupt):
        command.main([*SMALL, *TOY, "--out", str(tmp_path)])
    (path,) = tmp_path.iterdir()
    content = json.loads(path.read_text())
    assert path.name.endswith(".partial.json") and content["complete"] is False
    rows = [row for group in measured for row in group.values()]
    assert [row["name"] for row in content["rows"]] == [row.name for row in rows]
    assert [row["seconds"] for row in content["rows"]] == [row.seconds for row in rows]


@pytest.mark.parametrize("command", [training_step, ngd_object])
def test_what_there_is_no_time_for_is_said(command, tmp_path, monkeypatch):
    monkeypatch.setattr(harness.DEADLINE, "end", math.inf)  # as it was before, afterwards
    report = command.Report

    def late(*args):
        harness.DEADLINE.set("0")
        return report(*args)

    monkeypatch.setattr(command, "Report", late)
    path = Path(command.main([*SMALL, *TOY, "--out", str(tmp_path)]))
    content = json.loads(path.read_text())
    assert content["complete"] is False and path.name.endswith(".partial.json") and [path] == list(tmp_path.iterdir())
    assert not ran(content) and harness.NO_TIME in {row["reason"] for row in content["rows"]}


def test_extrapolation_repeats_the_steps_alone():
    once, each = 5.0, 3.0
    measured = {steps: once + each * steps for steps in (2, 4)}
    assert ngd_object.extrapolated(measured, 64) == pytest.approx(once + each * 64)
    assert ngd_object.extrapolated({2: 9.0, 4: 8.0}, 64) == pytest.approx(2.0 * 64)


def test_training_step_times_a_step_and_finds_the_largest_batch(tmp_path):
    content = run(training_step, tmp_path, "--batch", "2", "--memory", "0.5")
    row = ran(content)["torch, eager"]
    assert row["more"]["images/s"] == pytest.approx(2 / row["seconds"]["median"])
    assert content["settings"]["largest batch in 0.5 GiB, computed in 32-true"] > 0


@pytest.mark.parametrize("most", [0, 1, 5, 8, 100])
def test_the_largest_that_fits(most):
    assert training_step.largest(lambda number: number <= most) == most


def test_all_of_them_are_planned_within_the_time(tmp_path):
    arguments = all_of_them._arguments(["--minutes", "5", "--model", "base", "--sweeps", "--out", str(tmp_path)])
    jobs = all_of_them.plan(arguments)
    assert [name for name, _, _ in jobs[:6]] == list(all_of_them.SHARES)
    modules = {m.__name__: m for m in (render, unet, inner_step, ngd_object, training_step, field_speed)}
    for name, _, options in jobs:
        parsed = modules[name]._arguments(options)
        assert parsed.out == tmp_path and parsed.model == "base"


def test_one_that_fails_or_takes_too_long_does_not_stop_the_others(monkeypatch, capfd, tmp_path):
    monkeypatch.setattr(all_of_them, "SHARES", {"nothing_here": 1.0})
    assert all_of_them.main(["--minutes", "1", "--out", str(tmp_path)]) == 1
    monkeypatch.setattr(all_of_them, "SHARES", {"render": 1.0, "nothing_here": 1.0})
    assert all_of_them.main(["--minutes", "0.0001", "--out", str(tmp_path)]) == 2
    assert "stopped after" in capfd.readouterr().err
