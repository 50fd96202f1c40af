"""The record of a field's fit, step by step."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path

from nerfdiff.metrics.summary import write_csv
from nerfdiff.utils.files import atomic

TRACE = "trace.csv"
PLOT = "trace.png"


@dataclass(frozen=True)
class Step:
    """Record one step of the teacher.

    Args:
        t: diffusion time, where all views share one.
        weight: of guidance, where there is any.
        loss_first, loss_last: mean squared error of the rays of the first and the last inner step, if there are any.
        agreement: PSNR of the field's renderings against the targets before they were fitted, in dB: of all pixels
            where the method renders them, else of the first inner step's rays; None if there are none.
    """

    t: float | None
    weight: float | None
    loss_first: float | None
    loss_last: float | None
    agreement: float | None


def write_trace(path: Path, trace: Sequence[Step]) -> None:
    """Write one row per step, atomically; values that a method does not have are empty cells."""
    rows = [{"step": number} | asdict(step) for number, step in enumerate(trace)]
    write_csv(path, ["step", *(field.name for field in fields(Step))], rows)


def plot_trace(path: Path, trace: Sequence[Step]) -> None:
    """Plot losses, weight and agreement over the steps."""
    from matplotlib.figure import Figure  # not pyplot: no global state, and no display

    figure = Figure(figsize=(9, 2.6), layout="constrained")
    losses, weight, agreement = figure.subplots(1, 3)
    losses.plot([step.loss_first for step in trace], label="first inner step")
    losses.plot([step.loss_last for step in trace], label="last")
    losses.set(title="loss (MSE of rays)", xlabel="step", yscale="log")
    losses.legend(frameon=False)
    if any(step.weight is not None for step in trace):
        weight.plot([step.t for step in trace], [step.weight for step in trace])
        weight.set(title="guidance weight w", xlabel="t", ylim=(-0.05, 1.05), xlim=(1.02, -0.02))
    else:
        weight.set_axis_off()
    agreement.plot([step.agreement for step in trace])
    agreement.set(title="renderings against targets, dB", xlabel="step")
    with atomic(path) as temporary:
        figure.savefig(temporary, dpi=90)
