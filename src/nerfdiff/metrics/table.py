"""The metrics, each with all that rows, tables, dashboards and the chart say of it."""

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from nerfdiff.utils.errors import ConfigError

ARROWS = {"higher": " ↑", "lower": " ↓", "one": " (1)", None: ""}
PER = ("image", "scene", "run")
MARK = " †"
REPEATS = "one image repeated and views of other scenes"
LONGEST = 60  # letters of a label or unit


@dataclass(frozen=True)
class Metric:
    """One metric.

    Args:
        name: of its field in a result row and of its column in scores.
        label: what people read.
        better: `higher`, `lower`, or `one` where 1 is best; None where none is better.
        unit: empty where there is none.
        digits: shown after the decimal point.
        per: what has a value of its own: an `image`, a whole `scene`, or a `run` with all its scenes.
        within: distance from the best at which the chart's advice begins; None leaves the metric out of the chart.
        compared: sweeps show differences to their reference and the frontier for it, and blank scenes are told apart.
        detail: TensorBoard shows it among the details.
        rewards: what failure it rewards (docs/stability.md); None where none is known.
        measure: of your own metric: images [n, 3, h, w] in [0, 1], predicted and true, to values [n].

    Raises:
        ConfigError: a value that is none of these.
    """

    name: str
    label: str
    better: str | None = "higher"
    unit: str = ""
    digits: int = 3
    per: str = "image"
    within: float | None = None
    compared: bool = False
    detail: bool = False
    rewards: str | None = None
    measure: Callable[..., Any] | None = field(default=None, compare=False)

    def __post_init__(self):
        for key, fits, expected in (
            ("name", isinstance(self.name, str) and self.name.isidentifier(), "letters, digits and _"),
            ("label", _is_text(self.label), f"text of at most {LONGEST} letters"),
            ("unit", _is_text(self.unit), f"text of at most {LONGEST} letters"),
            ("better", self.better in ARROWS, "higher, lower, one or null"),
            ("digits", type(self.digits) is int and 0 <= self.digits <= 9, "0 to 9"),
            ("per", self.per in PER, ", ".join(PER)),
            ("within", self.within is None or self._has_advice(), "a positive number, and a better of higher or lower"),
            *((key, type(getattr(self, key)) is bool, "true or false") for key in ("compared", "detail")),
        ):
            if not fits:
                raise ConfigError(f"metric {self.name}: {key}={getattr(self, key)!r}: expected {expected}")

    def _has_advice(self) -> bool:
        return type(self.within) in (int, float) and 0 < self.within < math.inf and self.better in ("higher", "lower")

    @property
    def heading(self) -> str:
        """The label, a mark where the metric rewards a failure, and an arrow to where it is better."""
        return f"{self.label}{MARK if self.rewards else ''}{ARROWS[self.better]}"

    @property
    def format(self) -> str:
        return f".{self.digits}f"

    @property
    def sign(self) -> int:
        """1 where higher is better, else -1."""
        return 1 if self.better == "higher" else -1

    def description(self) -> dict[str, Any]:
        """The arguments that make it again, but for its name and how it is measured."""
        return {key: value for key, value in vars(self).items() if key not in ("name", "measure")}


def _is_text(value: object) -> bool:
    return isinstance(value, str) and len(value) <= LONGEST and value.isprintable()


def _table(*metrics: Metric) -> dict[str, Metric]:
    return {metric.name: metric for metric in metrics}


METRICS = _table(
    Metric("psnr", "PSNR", unit="dB", digits=2, within=0.1, compared=True),
    Metric("ssim", "SSIM", within=0.005, compared=True),
    Metric("ssim_gaussian", "SSIM (Gaussian)"),
    Metric("lpips", "LPIPS", "lower", within=0.005, compared=True),
    Metric("fid", "FID", "lower", digits=2, per="run", within=1.0, rewards="views of other scenes"),
    Metric("st_lpips_vgg", "ST-LPIPS", "lower", within=0.005, compared=True),
    Metric("fd_st_vgg", "FD ST-VGG", "lower", digits=2, per="run", within=5.0, rewards=REPEATS),
    Metric("sharpness", "sharpness", "one", digits=2, detail=True, rewards="speckle on blur"),
    Metric("depth_abs_rel", "depth abs rel", "lower", within=0.002, detail=True),
    Metric("depth_rmse", "depth RMSE", "lower", detail=True),
    Metric("mask_iou", "mask IoU", detail=True),
    Metric("floaters", "floaters", "lower", per="scene", within=0.01, detail=True),
    Metric("depth_extent", "depth extent", "one", digits=2, per="scene", detail=True),
    Metric(
        *("consistency_psnr", "consistency PSNR"),
        unit="dB",
        digits=2,
        per="scene",
        within=0.5,
        detail=True,
        rewards="white views and blur",
    ),
    Metric("consistency_psnr_truth", "of truth", None, "dB", digits=2, per="scene", detail=True),
)
"""By name, in the order in which all show them. `register` adds those that come with a config or with a row."""
PACKAGE = tuple(METRICS.values())
"""The metrics that a result row has fields for."""
TAKEN = set(METRICS)
"""Names that no other metric can have: `results.row` adds those of a row's other fields."""


def register(metric: Metric) -> None:
    """Add a metric of somebody's own; of two with one name the first is described."""
    METRICS.setdefault(metric.name, metric)


def own(settings: Mapping[str, Mapping[str, Any]]) -> list[Metric]:
    """Metrics of somebody's own, registered.

    Args:
        settings: by name, the other arguments of `Metric`.

    Raises:
        ConfigError: settings that do not make a metric, or a name that is taken.
    """
    made = []
    for name, values in settings.items():
        if name in TAKEN:
            raise ConfigError(f"metrics.own.{name}: results have a field of this name already; choose another")
        try:
            made.append(Metric(name, **values))
        except TypeError as error:
            raise ConfigError(f"metrics.own.{name}: {error}") from error
        register(made[-1])
    return made


def named(*per: str) -> list[str]:
    """Names of the metrics of which an image, a scene or a run has a value."""
    return [metric.name for metric in METRICS.values() if metric.per in per]


def reward_note(headings: Iterable[str]) -> str | None:
    """Return words on those metrics under `headings` that reward a failure; None where none does."""
    shown = tuple(headings)
    told = [
        f"{metric.label} rewards {metric.rewards}"
        for metric in METRICS.values()
        if metric.rewards and any(metric.heading in heading for heading in shown)
    ]
    return f"†: {'; '.join(told)}. Read it beside the others." if told else None
