"""The table of metrics, and those that come beside it."""

import json

import pytest

from nerfdiff.chart.payload import charted
from nerfdiff.evaluation.dashboard import accuracy_layout
from nerfdiff.metrics.table import METRICS, PACKAGE, Metric, named, own
from nerfdiff.results.row import ResultRow, append_row, flatten, read_rows
from nerfdiff.results.table import cells
from nerfdiff.sweeps.frontier import Frontier
from nerfdiff.utils.errors import ConfigError

ERROR = {"label": "error", "better": "lower", "unit": "m", "digits": 1, "within": 0.5}


@pytest.fixture(autouse=True)
def table():
    before = dict(METRICS)
    yield
    METRICS.clear()
    METRICS.update(before)


def test_every_place_knows_every_metric():
    row = ResultRow(run_id="r", strategy="s", **{metric.name: 1.0 for metric in PACKAGE})
    headings, (values,) = cells([row])
    shown = dict(zip(headings, values, strict=True))
    assert shown == {"strategy": "s"} | {m.heading: f"{1:.{m.digits}f}" for m in PACKAGE}
    assert {"PSNR ↑", "FID † ↓", "sharpness † (1)", "of truth"} < set(headings)
    assert [metric["field"] for metric in charted()] == [m.name for m in PACKAGE if m.within is not None]
    assert set(named("image", "scene", "run")) == {m.name for m in PACKAGE}
    assert accuracy_layout()["Accuracy"]["PSNR, dB"] == ["accuracy/1_psnr"]


def test_a_row_says_what_its_own_metrics_are(tmp_path):
    path = tmp_path / "results.jsonl"
    described = {"mistake": {"value": 0.25} | ERROR, "none": {"value": None, "label": "n"}}
    append_row(path, ResultRow(run_id="r", own_metrics=described))
    (row,) = read_rows(path)
    assert METRICS["mistake"] == Metric("mistake", **ERROR) and METRICS["mistake"].sign == -1
    assert [row.measured(name) for name in ("mistake", "none", "psnr", "other")] == [0.25, None, None, None]
    assert flatten(row)["mistake"] == 0.25 and cells([row]) == (["error ↓"], [["0.2"]])
    assert charted()[-1] == {"field": "mistake", "name": "error"} | {k: v for k, v in ERROR.items() if k != "label"}
    assert Frontier("scene_s", ["mistake"])([], []) == []


@pytest.mark.parametrize(
    "described",
    [
        {"mistake": {"value": "high", "label": "e"}},
        {"mistake": {"value": 1e300, "label": "e"}},
        {"mistake": {"value": 1.0}},
        {"mistake": {"value": 1.0, "label": "e", "better": "up"}},
        {"mistake": {"value": 1.0, "label": "e" * 61}},
        {"mistake": {"value": 1.0, "label": "e", "within": "0.1"}},
        {"mistake": {"value": 1.0, "label": "e", "digits": 1000}},
        {"mistake": {"value": 1.0, "label": "e", "measure": "os.system"}},
        {"mistake": {"value": 1.0, "label": "e", "colour": "red"}},
        {"an error": {"value": 1.0, "label": "e"}},
        {"seed": {"value": 1.0, "label": "e"}},
        {"mistake": 1.0},
        [],
    ],
    ids=str,
)
def test_a_line_whose_metrics_are_none_is_no_row(tmp_path, described):
    path = tmp_path / "results.jsonl"
    path.write_text(json.dumps({"schema_version": 2, "run_id": "r", "own_metrics": described}) + "\n")
    assert read_rows(path) == []
    assert len(METRICS) == len(PACKAGE)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"psnr": ERROR}, r"metrics\.own\.psnr: results have a field of this name already"),
        ({"seed": ERROR}, r"metrics\.own\.seed: results have a field of this name already"),
        ({"mistake": {"better": "lower"}}, r"metrics\.own\.mistake: .*label"),
        (
            {"mistake": ERROR | {"better": "down"}},
            r"metric mistake: better='down': expected higher, lower, one or null",
        ),
        (
            {"mistake": ERROR | {"better": None}},
            r"metric mistake: within=0\.5: expected a positive number, and a better",
        ),
    ],
)
def test_own_metrics_that_are_none_are_said(settings, message):
    with pytest.raises(ConfigError, match=message):
        own(settings)
