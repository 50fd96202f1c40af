"""How benchmarks measure, apart from how long anything takes."""

import itertools
import json
import math
import time
from types import SimpleNamespace

import pytest
import torch
from torch import nn

import costs
import harness
import report
from harness import Limits, Row, Unavailable, Work, interleaved
from model_fixtures import CONFIG, model
from nerfdiff.render.renderer import Renderer
from nerfdiff.utils import timing
from subjects import Subject

CPU = torch.device("cpu")


@pytest.fixture
def takes(monkeypatch):
    """Makes work that takes so many seconds of a clock that nothing else moves."""
    now = [0.0]
    monkeypatch.setattr(timing, "time", SimpleNamespace(perf_counter=lambda: now[0]))

    def work(*seconds, seen=None):
        durations = itertools.cycle(seconds)

        def call():
            now[0] += next(durations)
            if seen is not None:
                seen.append(seconds)

        return call

    return work


def test_ratios_are_to_the_first_variant_of_the_same_round(takes):
    # the machine slows down and up again, for both: twice as fast in every round
    rows = interleaved({"slow": takes(0.04, 0.08), "fast": takes(0.02, 0.04)}, CPU, 1.0)
    assert rows["slow"].ratio == 1 and rows["fast"].ratio == pytest.approx(2)
    assert rows["slow"].seconds["n"] == rows["fast"].seconds["n"] >= 3
    assert rows["fast"].seconds["median"] == pytest.approx(0.03, abs=0.0101)
    assert rows["fast"].seconds["iqr"] == pytest.approx(0.02)


def test_variants_take_turns(takes):
    seen = []
    interleaved({"a": takes(0.1, seen=seen), "b": takes(0.2, seen=seen)}, CPU, 1.0)
    assert seen[:6] == 3 * [(0.1,)] + 2 * [(0.2,)] + [(0.1,)]  # warm-ups, of at most a third of the time
    assert seen[5:] == (len(seen) - 5) // 2 * [(0.1,), (0.2,)] and len(seen) >= 11


def test_what_is_slow_is_measured_at_least_once(takes):
    row = interleaved({"slow": takes(100.0)}, CPU, 1.0)["slow"]
    assert row.seconds == {"n": 1, "median": 100.0, "iqr": 0.0}


def test_after_the_deadline_what_has_begun_is_measured_once_more(takes, monkeypatch):
    monkeypatch.setattr(harness.DEADLINE, "end", math.inf)
    slow = takes(0.1)

    def last():
        harness.DEADLINE.set("0")
        slow()

    rows = interleaved({"begun": takes(0.1), "last": last, "late": takes(0.1)}, CPU, 1.0)
    assert rows["begun"].seconds["n"] == rows["last"].seconds["n"] == 1
    assert (rows["late"].seconds, rows["late"].reason) == (None, harness.NO_TIME)


def test_what_cannot_run_is_a_row_with_its_reason(takes):
    def fails():
        raise RuntimeError("no such unit\nand a long tail")

    rows = interleaved({"works": takes(0.01), "cannot": Unavailable("needs wings"), "fails": fails}, CPU, 0.01)
    assert rows["works"].seconds is not None
    assert (rows["cannot"].seconds, rows["cannot"].reason) == (None, "needs wings")
    assert (rows["fails"].ratio, rows["fails"].reason) == (None, "no such unit")


def test_a_reference_that_fails_is_an_error():
    with pytest.raises(RuntimeError, match="broken"):
        interleaved({"reference": lambda: (_ for _ in ()).throw(RuntimeError("broken"))}, CPU, 0.01)


def test_a_quick_call_is_measured_many_times_at_once(takes):
    seen = []
    row = interleaved({"quick": takes(1e-4, seen=seen)}, CPU, 0.05)["quick"]
    assert len(seen) == pytest.approx(row.seconds["n"] * harness.SHORTEST / 1e-4, rel=0.1)
    assert row.seconds["median"] == pytest.approx(1e-4)


def test_the_devices_limits_are_those_of_a_copy_and_a_product():
    limit = harness.limits(CPU, torch.float32, 0.05)
    assert 1e8 < limit.copy < 1e13 and 1e8 < limit.matrix < 1e15 and limit.dtype == "float32"


def test_the_file_says_what_was_measured_on_what(tmp_path, capsys):
    subject = Subject("toy model", model(), CONFIG, 16, CPU, "32-true")
    rows = [Row("plain", {"rays": n}, {"n": 3, "median": n / 10, "iqr": 0.01}, 1.0, Work(2e9, 4e8)) for n in (1, 2)] + [
        Row("fused", {"rays": n}, reason="needs wings") for n in (1, 2)
    ]
    table = report.Report("render", subject, Limits(1e10, 1e12, "float32"), {"K": 3}, tmp_path, ["a note"], "rays")
    table.add(rows)
    path = table.finish()
    content = json.loads(path.read_text())
    facts = content["environment"]
    assert path.name == f"render-rays-toy-model-{report.slug(facts['cpu'])}-{content['time'][:10]}.json"
    assert path.with_suffix(".png").stat().st_size > 1000
    assert {"torch", "threads", "git_sha", "git_dirty", "precision"} <= facts.keys()
    assert content["model"] == "toy model" and content["parameters"]["total"] > 0 and content["settings"] == {"K": 3}
    first = content["rows"][0]
    assert first["share_of_matrix_rate"] == pytest.approx(2e9 / 0.1 / 1e12)
    assert first["share_of_copy_bandwidth"] == pytest.approx(4e8 / 0.1 / 1e10)
    assert content["rows"][3]["reason"] == "needs wings" and content["rows"][3]["share_of_matrix_rate"] is None
    shown = capsys.readouterr().out
    assert "a note" in shown and shown.count("needs wings") == 1 and "2.0 %" in shown and "40.0 %" in shown


@pytest.mark.parametrize(
    ("seconds", "text"), [(2.5, "2.5 s"), (0.0123, "12.3 ms"), (4.2e-5, "42 µs"), (0.0, "0 µs"), (1234.5, "1,234 s")]
)
def test_durations_are_read_at_a_glance(seconds, text):
    assert report.duration(seconds) == text


def test_a_convolution_counts_two_operations_for_every_product():
    layer = nn.Conv2d(3, 5, 3, padding=1, device="meta")
    x = torch.empty(2, 3, 8, 8, device="meta")
    work = costs.counted(lambda: layer(x), torch.float32)
    assert work.flops == 2 * (2 * 8 * 8) * 5 * 3 * 9
    assert work.bytes == 4 * (2 * 3 * 64 + 5 * 3 * 9 + 5 + 2 * 5 * 64)
    half = costs.counted(lambda: layer(x), torch.bfloat16)
    assert half.bytes == work.bytes / 2


def test_attention_counts_both_of_its_products():
    q = torch.empty(1, 2, 16, 8, device="meta")
    work = costs.counted(lambda: nn.functional.scaled_dot_product_attention(q, q, q), torch.float32)
    assert work.flops == 2 * 2 * (2 * 16 * 16 * 8)


def test_the_work_of_u_nets_grows_with_what_they_are_given():
    one, four = (costs.denoising(CONFIG, 16, views, torch.float32) for views in (1, 4))
    # but for cross-attention's keys, which views share
    assert 3.5 * one.flops < four.flops <= 4 * one.flops
    assert costs.training(CONFIG, 16, 2, 1, torch.float32).flops > 3 * 2 * one.flops


def test_the_work_of_rendering_is_that_of_its_samples():
    def work(uniform, importance, rays, backward):
        renderer = Renderer(uniform, importance, 1.0, 4096)
        return costs.rendering(renderer, CONFIG, 16, rays, 1, backward)

    channels, hidden = 8, 16
    by_hand = 5 * 12 * (3 * 4 * 2 * channels + 2 * channels * hidden + 2 * hidden * 4)
    assert work(8, 4, 5, False).flops == by_hand and work(6, 6, 5, True).flops == 3 * by_hand
    assert work(8, 4, 5, False).bytes == work(64, 64, 5, False).bytes  # samples need not leave the processor


def test_a_variant_that_overruns_its_share_is_dropped_and_the_others_are_not(monkeypatch):
    monkeypatch.setattr(harness.DEADLINE, "end", time.time() + 0.3)
    rows = interleaved({"hangs": lambda: time.sleep(60), "works": lambda: None}, CPU, 0.001)
    assert rows["hangs"].seconds is None and "its share of the time" in rows["hangs"].reason
    assert rows["works"].seconds["n"] >= 1 and rows["works"].ratio is None


def test_a_slow_variant_leaves_the_others_their_rounds(takes, capsys):
    rows = interleaved({"slow": takes(5.0), "quick": takes(0.01)}, CPU, 1.0)
    assert rows["slow"].seconds == {"n": 1, "median": 5.0, "iqr": 0.0}
    assert rows["quick"].seconds["n"] > 50 and rows["quick"].ratio == pytest.approx(500)
    assert "slow: 5 s a call at first" in capsys.readouterr().out
