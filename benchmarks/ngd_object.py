"""One object distilled: encoded, conditions rendered, then at every step denoised, rendered and fitted.

    python benchmarks/ngd_object.py --model base --budget paper --compile --few --whole --seconds 1 --device cuda
    python benchmarks/ngd_object.py --model base --budget paper --steps 4 --extrapolate --compile
    python benchmarks/ngd_object.py --ckpt demo --budget minutes --with strategy.coarse=refresh budget.deep_every=2

The first command is for the goal of an object by model B in less than 6 s on one H100: it times all diffusion steps by
the reference, by the fastest way that changes nothing, and by "fast". The reference is the plain renderer, eager U-Nets
and no CUDA graph. "fast" does the same as the last way before it, with a distillation that --with changes; unless told
otherwise, by coarse weights that are kept between refreshes. The second command times objects of 2 and of 4 diffusion
steps and computes what all of them would take; its rows say so.
"""

import argparse
import copy
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from hydra.utils import instantiate

import costs
from harness import Row, Unavailable, Work, interleaved, parser, settings_of
from inner_step import steps_of
from nerfdiff.cli import choices, load_config
from nerfdiff.data.batch import ViewBatch
from nerfdiff.diffusion.denoiser import cast_products
from nerfdiff.diffusion.sampler import time_steps
from nerfdiff.distill.distillation import Distillation
from nerfdiff.distill.virtual_views import VirtualViews
from nerfdiff.fit.inner_steps import InnerSteps
from nerfdiff.fit.refined_field import RefinedField
from nerfdiff.model import NerfDiff
from nerfdiff.utils.config import plain
from nerfdiff.utils.errors import ConfigError
from report import Report
from subjects import Subject, scene, subject
from variants import models, renderers

SWEEPS = {"views": (5, 10, 25, 50, 100), "scenes": (1, 2, 4, 8)}
REFERENCE, FAST = "reference", "fast"
FIT = "N inner steps"
CHANGED = ("render K views", FIT)
"""Parts in which kept coarse weights make a difference."""


@dataclass(frozen=True)
class Plan:
    """The settings an object is made with.

    Args:
        strategy, budget: as configured.
        steps: diffusion steps to time, at most.
    """

    strategy: dict[str, Any]
    budget: dict[str, Any]
    steps: int | None

    @staticmethod
    def of(arguments: argparse.Namespace, changes: Sequence[str], views: int | None = None) -> "Plan":
        """With these overrides of the distillation's config.

        Raises:
            ConfigError: an override names no key, or the strategy fits no field.
        """
        words = ["ckpt=none", "data=srn_cars", f"strategy={arguments.strategy}", f"budget={arguments.budget}", *changes]
        cfg = load_config("distill", words + ([] if views is None else [f"budget.views={views}"]))
        if "teacher" not in cfg.strategy:
            raise ConfigError(
                f"strategy={arguments.strategy} fits no field to an object: choose one that has a teacher"
            )
        return Plan(plain(cfg.strategy), plain(cfg.budget), arguments.steps)

    @property
    def timed(self) -> int:
        """Diffusion steps that are timed."""
        return min(self.steps or self.budget["steps"], self.budget["steps"])

    def method(self, steps: int) -> Distillation:
        """Fewer steps than the budget's leave nothing out: how many have full guidance is no fixed share of them."""
        teacher = self.strategy["teacher"] | {"steps": steps}
        if steps < self.budget["steps"] and "at_full_guidance" in teacher:
            teacher["at_full_guidance"] = "everything"
        return instantiate(self.strategy | {"teacher": teacher})

    def asked(self, steps: int) -> tuple[int, int]:
        """Return in how many of so many steps the denoiser is asked, and the field fitted."""
        given = self.method(steps).teacher.keywords
        if "guidance" not in given or self.timed < self.budget["steps"]:
            return steps, steps
        times = time_steps(steps, given["t_max"], given["t_min"], given["spacing"])[:-1]
        full = sum(given["guidance"].replaces(t) for t in times)
        at = given["at_full_guidance"]
        return steps - full * (at != "everything"), steps - full * (at == "nothing")

    @property
    def keeps_coarse(self) -> bool:
        """Return true if inner steps draw from weights that rendering for the teacher found."""
        return self.strategy["coarse"] == "refresh" and self.method(1).teacher.func.follows_field

    def warning(self, extrapolate: bool) -> str | None:
        """Say which steps are not timed; None where all are."""
        every = self.budget["steps"]
        if self.timed == every:
            return None
        if extrapolate:
            return f"EXTRAPOLATED: objects are computed from {self.timed} of {every} diffusion steps, none left out"
        return f"PARTIAL: objects are of {self.timed} diffusion steps, where the budget has {every}"


@dataclass(frozen=True)
class Way:
    """A way to make objects."""

    model: NerfDiff
    cuda_graphs: bool
    plan: Plan


def main(words: list[str] | None = None) -> str:
    arguments = _arguments(words)
    measured = subject(arguments)
    exact, fast = Plan.of(arguments, ()), Plan.of(arguments, arguments.fast)
    if fast.budget["views"] != exact.budget["views"]:
        raise ConfigError("--with budget.views=…: all ways have the same views; take --sweep views --values …")
    every = fast.budget["deep_every"]
    if arguments.extrapolate and fast.timed < fast.budget["steps"] and (fast.timed % 2 or fast.timed // 2 % every):
        raise ConfigError(f"--extrapolate with budget.deep_every={every}: --steps must be a multiple of {2 * every}")
    usual = {"views": exact.budget["views"], "scenes": arguments.scenes}
    settings = {"strategy": arguments.strategy, "budget": arguments.budget} | exact.budget | usual
    settings |= {"steps timed": exact.timed, FAST: " ".join(arguments.fast)}
    settings |= {"overrides": " ".join(arguments.overrides)} if arguments.overrides else {}
    warnings = dict.fromkeys(plan.warning(arguments.extrapolate) for plan in (exact, fast))
    notes = [warning for warning in warnings if warning]
    notes.append(f"{FAST}: as the way before it, with {settings[FAST]}")
    limit = measured.limits(arguments.seconds)
    report = Report("ngd_object", measured, limit, settings, arguments.out, notes, arguments.sweep)
    for setting in settings_of(arguments, usual, SWEEPS):
        _measure(arguments, measured, setting, report)
    return str(report.finish())


def _measure(arguments: argparse.Namespace, measured: Subject, setting: dict[str, int], report: Report) -> None:
    scenes = [scene(measured, 1, seed=number) for number in range(setting["scenes"])]
    ways = _ways(arguments, measured, setting["views"])
    seconds = arguments.seconds
    for variants in [] if arguments.whole else _parts(measured, ways, scenes, setting, seconds):
        report.add(variants)
    timed = {name: way.plan.timed for name, way in ways.items() if isinstance(way, Way)}
    found = _objects(measured, ways, timed, scenes, seconds)
    ran = {name: row for name, row in found.items() if row.seconds}
    fewer = {name: timed[name] // 2 for name in ran if timed[name] < ways[name].plan.budget["steps"]}
    if arguments.extrapolate and fewer:
        short = _objects(measured, {name: ways[name] for name in fewer}, fewer, scenes, seconds)
        reference = found[REFERENCE]
        for name, steps in fewer.items():
            row, every = ran[name], ways[name].plan.budget["steps"]
            if short[name].seconds is None:
                row.seconds, row.ratio, row.reason = None, None, short[name].reason
                del ran[name]
                continue
            medians = {steps: short[name].seconds["median"], timed[name]: row.seconds["median"]}
            row.seconds |= {"median": extrapolated(medians, every), "iqr": row.seconds["iqr"] * every / timed[name]}
            row.more["extrapolated from steps"] = timed[name]
            timed[name] = every
        for row in ran.values():
            row.ratio = reference.seconds and reference.seconds["median"] / row.seconds["median"]
    for name, row in found.items():
        row.name = f"{setting['scenes']} objects, {name}" if setting["scenes"] > 1 else f"object, {name}"
        row.setting = setting
    for name, row in ran.items():
        row.work = _work(measured, ways[name].plan, setting, timed[name])
        row.more["s/object"] = row.seconds["median"] / setting["scenes"]
        row.more["objects/min"] = 60 * setting["scenes"] / row.seconds["median"]
    report.add(list(found.values()))


def extrapolated(seconds: dict[int, float], steps: int) -> float:
    """Seconds of `steps` steps on the line through two measurements {steps: seconds}: what is done once per object,
    setting up the loop included, is not multiplied. Where fewer steps took no less, which is chance, all is."""
    (few, short), (more, long) = sorted(seconds.items())
    each = (long - short) / (more - few) if long > short else long / more
    return long + each * (steps - more)


def _objects(
    measured: Subject,
    ways: dict[str, Way | Unavailable],
    steps: dict[str, int],
    scenes: Sequence[ViewBatch],
    seconds: float,
) -> dict[str, Row]:
    calls = {
        name: way if isinstance(way, Unavailable) else _distils(measured, way, steps[name], scenes)
        for name, way in ways.items()
    }
    return interleaved(calls, measured.device, seconds)


def _ways(arguments: argparse.Namespace, measured: Subject, views: int) -> dict[str, Way | Unavailable]:
    """Every renderer with every kind of U-Net, and the last of them made faster; only the reference records no CUDA
    graph."""
    exact, fast = Plan.of(arguments, (), views), Plan.of(arguments, arguments.fast, views)
    backends = renderers(measured.model, measured.model.renderer)
    ways: dict[str, Way | Unavailable] = {}
    for unets, model in models(measured.model.requires_grad_(False), arguments.compile).items():
        if unets != "eager" and measured.dtype == torch.bfloat16:  # copies, and as in evaluation
            cast_products(model.denoiser, torch.bfloat16)
        for name, renderer in backends.items():
            if isinstance(renderer, Unavailable):
                ways[f"{name}, {unets}"] = renderer
                continue
            own = copy.copy(model)  # of the module alone: its parts, and so its weights, are shared
            own.renderer = renderer
            last = f"{name}, {unets}" if ways else REFERENCE
            ways[last] = Way(own, last != REFERENCE, exact)
    if arguments.few:
        ways = {name: ways[name] for name in (REFERENCE, last)}
    return ways | {FAST: replace(ways[last], plan=fast)}


def _distils(measured: Subject, way: Way, steps: int, scenes: Sequence[ViewBatch]):
    method = way.plan.method(steps)
    own = replace(method, fit=replace(method.fit, cuda_graphs=way.cuda_graphs))

    def call():
        with measured.autocast():
            own.distil(way.model, scenes, 0)
        if way.cuda_graphs and measured.device.type == "cuda" and not InnerSteps.recording:
            raise RuntimeError("its inner steps could not be recorded as a CUDA graph")

    return call


def _parts(
    measured: Subject,
    ways: dict[str, Way | Unavailable],
    scenes: Sequence[ViewBatch],
    setting: dict[str, int],
    seconds: float,
) -> Iterator[list[Row]]:
    """Time an object's parts one by one: of one scene, but for those that scenes share."""
    dtype, config, size = measured.dtype, measured.config, measured.size
    views_rendered = costs.rendering(measured.model.renderer, config, size, setting["views"] * size**2, 1, False)
    works = {
        "encode": costs.encoding(config, size, dtype),
        "conditions": views_rendered,
        "denoise K views": costs.denoising(config, size, setting["views"], dtype),
        "render K views": views_rendered,
    }
    calls: dict[str, dict[str, Any]] = {part: {} for part in (*works, FIT)}
    for name, way in ways.items():
        pieces = (
            dict.fromkeys(calls, way) if isinstance(way, Unavailable) else _pieces(measured, way, scenes[0], setting)
        )
        for part in CHANGED if name == FAST else calls:
            calls[part][name] = pieces[part]
    for part, variants in calls.items():
        rows = interleaved(variants, measured.device, seconds)
        for name, row in rows.items():
            row.name, row.setting = f"{part}, {name}", setting
            if row.seconds is not None:
                row.work = works.get(part) or _fitting(measured, ways[name].plan.budget, setting["scenes"])
        yield list(rows.values())


def _fitting(measured: Subject, budget: dict[str, int], scenes: int) -> Work:
    """Count the work of N inner steps."""
    renderer, size = measured.model.renderer, measured.size
    one = costs.rendering(renderer, measured.config, size, budget["rays"], scenes, backward=True)
    return Work(one.flops * budget["inner_steps"], one.bytes * budget["inner_steps"])


def _pieces(measured: Subject, way: Way, one: ViewBatch, setting: dict[str, int]) -> dict[str, Any]:
    method, budget, keep = way.plan.method(1), way.plan.budget, way.plan.keeps_coarse
    model, cameras = way.model, method.prior(one)

    def encode():
        with torch.no_grad(), measured.autocast():
            return model.encode(one)

    encoding = encode()

    def conditions():
        with measured.autocast():
            return VirtualViews(model, encoding, cameras, method.views_at_once, (0,))

    views = conditions()
    field = RefinedField(encoding.triplane, model.decoder)
    z, t = views.noise(), torch.full((len(views),), 0.5, device=measured.device)

    def denoise():
        with measured.autocast():
            views.denoise(z, t)

    def render():
        with torch.no_grad(), measured.autocast():
            field.render(method.fit.guidance(model.renderer), cameras, keep_coarse=keep)

    shape = {"rays": budget["rays"], "plane": measured.size} | setting
    return {
        "encode": encode,
        "conditions": conditions,
        "denoise K views": denoise,
        "render K views": render,
        FIT: steps_of(measured, model.renderer, shape, budget["inner_steps"], way.cuda_graphs, keep),
    }


def _work(measured: Subject, plan: Plan, setting: dict[str, int], steps: int) -> Work | None:
    """Count the work of NGD on all scenes: encoding, conditions, and denoising, rendering and N inner steps at all
    steps but those that leave them out. None where not all of the CDM is computed."""
    if plan.budget["deep_every"] > 1:
        return None
    config, size, renderer = measured.config, measured.size, measured.model.renderer
    pixels, (denoisings, fits) = setting["views"] * size**2, plan.asked(steps)
    encoding = costs.encoding(config, size, measured.dtype)
    shown = costs.rendering(renderer, config, size, pixels, 1, backward=False)
    guides = costs.rendering(plan.method(1).fit.guidance(renderer), config, size, pixels, 1, backward=False)
    denoised = costs.denoising(config, size, setting["views"], measured.dtype)
    fitted = _fitting(measured, plan.budget, 1)

    def total(name: str) -> float:
        once = getattr(encoding, name) + getattr(shown, name)
        each = denoisings * getattr(denoised, name) + fits * (getattr(guides, name) + getattr(fitted, name))
        return setting["scenes"] * (once + each)

    return Work(total("flops"), total("bytes"))


def _arguments(words):
    made = parser(__doc__, sweeps=tuple(SWEEPS))
    made.add_argument("--strategy", choices=choices("strategy"), default="ngd_current", help="one that fits a field")
    made.add_argument("--budget", choices=choices("budget"), default="minutes")
    made.add_argument("--scenes", type=int, default=1, help="distilled in one batch")
    made.add_argument("--steps", type=int, help="diffusion steps to time; default: all of the budget")
    made.add_argument("--extrapolate", action="store_true", help="from --steps to all of the budget's, and say so")
    made.add_argument("--whole", action="store_true", help="objects only, not their parts")
    made.add_argument("--few", action="store_true", help=f"{REFERENCE}, the last way and {FAST} only")
    made.add_argument(
        "--with",
        dest="fast",
        nargs="+",
        default=["strategy.coarse=refresh"],
        metavar="KEY=VALUE",
        help=f"of the distillation's config, what {FAST} changes; default: strategy.coarse=refresh",
    )
    made.add_argument(
        "--compile", action="store_true", help="also with compiled U-Nets; the first call takes up to minutes"
    )
    arguments = made.parse_args(words)
    if arguments.extrapolate and (arguments.steps or 0) < 2:
        made.error("--extrapolate needs --steps of at least 2")
    return arguments


if __name__ == "__main__":
    main()
