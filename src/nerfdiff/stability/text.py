"""Verdicts as Markdown."""

import math
from collections.abc import Mapping, Sequence

import numpy as np
from omegaconf import DictConfig

from nerfdiff.results.row import ResultRow
from nerfdiff.results.text import markdown_lines, one_line
from nerfdiff.stability.breaking import Breaking
from nerfdiff.stability.judge import OK
from nerfdiff.stability.study import Study, Verdict

RULES = (
    "A strategy is broken at a severity where (a) a tenth of its scenes fall back or have no finite result, (b) it is "
    "3 dB under its own clean result or under the better of the two baselines, (c) it is 0.5 dB worse than `none` at "
    "the same severity, or (d) its Fréchet distance is twice the clean one. Intervals are bootstrap intervals over "
    "scenes and seeds. A silent failure is a scene that (b) or (c) holds for by itself, with status ok and verdict ok."
)


def severity_text(stress: DictConfig, severity: float | None) -> str:
    """A severity with its unit, or in the words of its kind."""
    if severity is None:
        return "–"
    words = {float(key): word for key, word in stress.words.items()}
    if severity in words:
        return words[severity]
    unit = stress.unit
    if unit.startswith("×"):
        return f"×{severity:g}{unit[1:]}"
    return f"{severity:g}{'' if unit == '°' else ' ' if unit else ''}{unit}".strip()


def breaking_text(stress: DictConfig, breaking: Breaking) -> str:
    """A breaking point with its interval and the rules that hold; of an end beyond what was tested, a >."""
    beyond = f"> {severity_text(stress, breaking.furthest)}" if stress.ordered else "none"
    if breaking.severity is None:
        if breaking.interval[0] is None:
            return beyond
        return f"{beyond} [{severity_text(stress, breaking.interval[0])}, –]"
    text = severity_text(stress, breaking.severity)
    low, high = (severity_text(stress, end) if end is not None else "–" for end in breaking.interval)
    return f"{text} [{low}, {high}] ({breaking.rules})"


def to_markdown(found: Sequence[Study], waiting: Sequence[str] = (), left_out: Sequence[str] = ()) -> str:
    """Breaking points by axis and strategy, then areas and means.

    Args:
        waiting: jobs that were not run.
        left_out: what the sweep leaves out, and why.
    """
    parts = ["# Stability\n"]
    for study in found:
        strategies = list(dict.fromkeys(verdict.strategy for verdict in study.verdicts))
        by = {(verdict.axis, verdict.strategy): verdict for verdict in study.verdicts}
        parts.append(f"{one_line(' '.join(study.settings))}\n")
        parts.append(f"**Silent failures: {study.silent} of {study.broken} broken scenes.**\n")
        parts.append(f"{RULES}\n")
        clean = [f"{study.clean[s]:.2f}" if s in study.clean else "–" for s in strategies]
        rows = [["axis", *strategies], ["clean PSNR, dB", *clean]]
        for axis in dict.fromkeys(verdict.axis for verdict in study.verdicts):
            stress = study.axes[axis]
            cells = [_cell(stress, by.get((axis, strategy))) for strategy in strategies]
            rows.append([stress.name, *cells])
        parts += ["## Breaking points\n", markdown_lines(rows), "\n## Loss against clean, divided by that of `none`\n"]
        rows = [["axis", *strategies]]
        for axis in dict.fromkeys(verdict.axis for verdict in study.verdicts):
            areas = [by[axis, s].area if (axis, s) in by else None for s in strategies]
            if any(value is not None for value in areas):
                rows.append([study.axes[axis].name, *("–" if a is None else f"{a:.2f}" for a in areas)])
        parts += [markdown_lines(rows), "\n## Every severity\n", markdown_lines(_lines(study))]
    if waiting:
        parts.append(f"\nNot run: {len(waiting)} jobs, the first {waiting[0]}; the same command goes on.\n")
    parts += [f"\nLeft out: {line}.\n" for line in left_out]
    return "\n".join(parts)


def _cell(stress: DictConfig, verdict: Verdict | None) -> str:
    if verdict is None:
        return "–"
    return " / ".join(breaking_text(stress, breaking) for breaking in verdict.breaking)


def _lines(study: Study) -> list[list[str]]:
    """A line per axis, strategy and severity: the mean with and without the scenes that fell back."""
    headings = ["axis", "strategy", "severity", "PSNR", "without fallbacks", "loss, dB", "failed", "suspect", "broken"]
    rows = [[*headings, "silent", "first broken scene"]]
    for verdict in study.verdicts:
        stress = study.axes[verdict.axis]
        for point in verdict.points:
            loss = point.loss
            ends = "" if loss is None or loss.low is None else f" [{loss.low:.2f}, {loss.high:.2f}]"
            first = min((failure.scene for failure in point.failures), default="–")
            rows.append(
                [
                    *(stress.name, verdict.strategy, severity_text(stress, point.severity)),
                    number_text(point.psnr.mean),
                    number_text(point.without_fallbacks),
                    "–" if loss is None else f"{loss.mean:.2f}{ends}",
                    *(f"{point.failed} of {point.total}", str(point.suspect), point.broken or "–"),
                    *(str(len(point.silent)), first),
                ]
            )
    return rows


def number_text(value: float | None) -> str:
    """Write a number with two digits after the point, or a dash where there is no finite one."""
    return "–" if value is None or not math.isfinite(value) else f"{value:.2f}"


COUNTS = ("loss_spikes", "nonfinite_grad_steps", "grad_norm_p99")


def training_markdown(rows: Sequence[ResultRow], axes: Mapping[str, DictConfig]) -> str:
    """A line per stress of training and severity: means over seeds, and how many runs did not end."""
    groups: dict[tuple[str, float | None], list[ResultRow]] = {}
    for row in rows:
        groups.setdefault((row.stress or "none", row.severity), []).append(row)
    table = [
        ["stress", "severity", "held-out PSNR, dB", "against clean of the same seeds", "CDM's held-out loss", "spikes"]
        + ["steps without a gradient", "99 % of gradient norms", "recovered", "suspect", "runs that ended"]
    ]
    clean = {row.seed: row.psnr for row in groups.get(("none", None), ()) if row.psnr is not None}
    for (axis, severity), own in sorted(
        groups.items(), key=lambda item: (item[0][0] != "none", item[0][0], item[0][1] or 0)
    ):
        gained = _mean([row.psnr - clean[row.seed] for row in own if row.psnr is not None and row.seed in clean])
        upset = [row for row in own if row.loss_spikes or row.nonfinite_grad_steps]
        recovered = (
            f"{sum(row.status == 'ok' and (row.verdict or OK) == OK for row in upset)} of {len(upset)}"
            if upset
            else "–"
        )
        stress = axes.get(axis)
        table.append(
            [
                stress.name if stress is not None else axis,
                severity_text(stress, severity) if stress is not None else "–",
                _with_spread([row.psnr for row in own]),
                "–" if gained is None else f"{gained:+.2f}",
                _with_spread([row.held_out_loss for row in own], 4),
                *(number_text(_mean([getattr(row, key) for row in own])) for key in COUNTS),
                recovered,
                f"{sum((row.verdict or OK) != OK for row in own)} of {len(own)}",
                f"{sum(row.status == 'ok' for row in own)} of {len(own)}",
            ]
        )
    said = (
        "Means over seeds, ± their standard deviation where there are several. A run is suspect if its held-out "
        "renderings are no better than pictures of one even colour. It has recovered if it had spikes or steps without "
        "a gradient, ended, and is not suspect."
    )
    return f"# Stability of training\n\n{said}\n\n{markdown_lines(table)}"


def _with_spread(values: Sequence[float | None], digits: int = 2) -> str:
    known = [value for value in values if value is not None and math.isfinite(value)]
    if not known:
        return "–"
    spread = f" ± {np.std(known, ddof=1):.{digits}f}" if len(known) > 1 else ""
    return f"{np.mean(known):.{digits}f}{spread}"


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None and math.isfinite(value)]
    return float(np.mean(known)) if known else None
