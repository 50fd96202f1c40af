import csv

import imageio.v2 as imageio
import numpy as np
import pytest

from nerfdiff.distill.trace import PLOT, TRACE, Step, plot_trace, write_trace

GUIDED = [Step(1.0, 1.0, 0.02, 0.01, 20.0), Step(0.5, 0.3, 0.01, 0.004, 25.0)]
UNGUIDED = [Step(None, None, None, None, 20.0)]


@pytest.mark.parametrize("trace", [GUIDED, UNGUIDED])
def test_a_trace_is_a_table_and_a_picture(trace, tmp_path):
    write_trace(tmp_path / TRACE, trace)
    with open(tmp_path / TRACE) as file:
        rows = list(csv.DictReader(file))
    assert [row["step"] for row in rows] == [str(n) for n in range(len(trace))]
    for row, step in zip(rows, trace, strict=True):
        assert float(row["agreement"]) == step.agreement
        assert row["t"] == ("" if step.t is None else f"{step.t:g}")
    plot_trace(tmp_path / PLOT, trace)
    assert np.ptp(imageio.imread(tmp_path / PLOT)) > 0
