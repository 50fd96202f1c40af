"""One object distilled: encoded, conditions rendered, then at every step denoised, rendered and fitted.

    python benchmarks/ngd_object.py --model base --budget paper --device cuda
    python benchmarks/ngd_object.py --ckpt demo --budget minutes
    python benchmarks/ngd_object.py --model base --budget paper --steps 2 --extrapolate

The reference is the plain renderer, eager U-Nets and no CUDA graph. The last command times objects of 1 and of 2
diffusion steps and computes what all of them would take; its rows say so.
"""

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from hydra.utils import instantiate

import costs
from harness import Row, Unavailable, Work, interleaved, parser, settings_of
from inner_step import steps_of
from nerfdiff.cli import load_config
from nerfdiff.data.batch import ViewBatch
from nerfdiff.distill.distillation import Distillation
from nerfdiff.distill.inner_steps import InnerSteps
from nerfdiff.distill.refined_field import RefinedField
from nerfdiff.distill.virtual_views import VirtualViews
from nerfdiff.model import NerfDiff
from nerfdiff.training import plain
from report import report
from subjects import Subject, scene, subject
from variants import models, renderers

SWEEPS = {"views": (5, 10, 25, 50, 100), "scenes": (1, 2, 4, 8)}
STRATEGIES = ("ngd", "ngd_current", "direct", "sds", "stochastic")


@dataclass(frozen=True)
class Way:
    """How objects are made."""

    model: NerfDiff
    cuda_graphs: bool


def main(words: list[str] | None = None) -> str:
    arguments = _arguments(words)
    measured = subject(arguments)
    limit = measured.limits(arguments.seconds)
    budget = plain(_config(arguments, {}).budget)
    usual = {"views": budget["views"], "scenes": arguments.scenes}
    rows: list[Row] = []
    for setting in settings_of(arguments, usual, SWEEPS):
        rows += _measure(arguments, measured, budget, setting)
    timed = arguments.steps or budget["steps"]
    settings = {"strategy": arguments.strategy, "budget": arguments.budget} | budget | usual | {"steps timed": timed}
    notes = []
    if timed < budget["steps"]:
        notes.append(
            f"EXTRAPOLATED: objects are computed from {timed} of {budget['steps']} diffusion steps"
            if arguments.extrapolate
            else f"PARTIAL: objects are of {timed} diffusion steps, where the budget has {budget['steps']}"
        )
    return str(report("ngd_object", measured, rows, limit, settings, arguments.out, notes, arguments.sweep))


def _config(arguments, setting: dict[str, int]):
    views = [f"budget.views={setting['views']}"] if setting else []
    words = ["ckpt=none", "data=srn_cars", f"strategy={arguments.strategy}", f"budget={arguments.budget}", *views]
    return load_config("distill", words)


def _measure(arguments, measured: Subject, budget: dict[str, int], setting: dict[str, int]) -> list[Row]:
    steps = min(arguments.steps or budget["steps"], budget["steps"])
    method = _method(arguments, setting, steps)
    scenes = [scene(measured, 1, seed=number) for number in range(setting["scenes"])]
    ways = _ways(measured, arguments.compile)
    rows: list[Row] = []
    if not arguments.whole:
        rows += _parts(measured, ways, method, scenes, budget, setting, arguments.seconds)
    found = _objects(measured, ways, method, scenes, arguments.seconds)
    for row in found.values():
        row.work = _work(measured, budget, setting, steps)
    if arguments.extrapolate and steps < budget["steps"]:
        fewer = steps // 2
        short = _objects(measured, ways, _method(arguments, setting, fewer), scenes, arguments.seconds)
        ran = {name: row for name, row in found.items() if row.seconds and short[name].seconds}
        for name, row in ran.items():
            medians = {fewer: short[name].seconds["median"], steps: row.seconds["median"]}
            row.seconds["median"] = extrapolated(medians, budget["steps"])
            row.seconds["iqr"] *= budget["steps"] / steps
            row.work = _work(measured, budget, setting, budget["steps"])
            row.more["extrapolated from steps"] = steps
            row.ratio = next(iter(ran.values())).seconds["median"] / row.seconds["median"]
    for name, row in found.items():
        row.name = f"{setting['scenes']} objects, {name}" if setting["scenes"] > 1 else f"object, {name}"
        if row.seconds is not None:
            row.more["s/object"] = row.seconds["median"] / setting["scenes"]
            row.more["objects/min"] = 60 * setting["scenes"] / row.seconds["median"]
    rows += found.values()
    for row in rows:
        row.setting = setting
    return rows


def extrapolated(seconds: dict[int, float], steps: int) -> float:
    """Seconds of `steps` steps on the line through two measurements {steps: seconds}: what is done once per object,
    setting up the loop included, is not multiplied."""
    (few, short), (more, long) = sorted(seconds.items())
    return short + (long - short) / (more - few) * (steps - few)


def _method(arguments, setting: dict[str, int], steps: int) -> Distillation:
    strategy = plain(_config(arguments, setting).strategy)
    strategy["teacher"]["steps"] = steps
    return instantiate(strategy)


def _objects(measured: Subject, ways, method: Distillation, scenes: Sequence[ViewBatch], seconds: float):
    calls = {
        name: way if isinstance(way, Unavailable) else _distils(measured, way, method, scenes)
        for name, way in ways.items()
    }
    return interleaved(calls, measured.device, seconds)


def _ways(measured: Subject, compiled: bool) -> dict[str, Way | Unavailable]:
    """Every renderer with every kind of U-Net; only the reference records no CUDA graph."""
    backends = renderers(measured.model, measured.model.renderer)
    ways: dict[str, Way | Unavailable] = {}
    for unets, model in models(measured.model.requires_grad_(False), compiled).items():
        for name, renderer in backends.items():
            reference = not ways
            if isinstance(renderer, Unavailable):
                ways[f"{name}, {unets}"] = renderer
                continue
            own = copy.copy(model)  # of the module alone: its parts, and so its weights, are shared
            own.renderer = renderer
            ways["reference" if reference else f"{name}, {unets}"] = Way(own, not reference)
    return ways


def _distils(measured: Subject, way: Way, method: Distillation, scenes: Sequence[ViewBatch]):
    own = replace(method, cuda_graphs=way.cuda_graphs)

    def call():
        with measured.autocast():
            own.distil(way.model, scenes, 0)
        if way.cuda_graphs and measured.device.type == "cuda" and not InnerSteps.recording:
            raise RuntimeError("its inner steps could not be recorded as a CUDA graph")

    return call


def _parts(
    measured: Subject,
    ways: dict[str, Way | Unavailable],
    method: Distillation,
    scenes: Sequence[ViewBatch],
    budget: dict[str, int],
    setting: dict[str, int],
    seconds: float,
) -> list[Row]:
    """What an object consists of, each by itself: of one scene, but for what scenes do together."""
    dtype, config, size = measured.dtype, measured.config, measured.size
    pixels, renderer = setting["views"] * size**2, measured.model.renderer
    views_rendered = costs.rendering(renderer, config, size, pixels, 1, backward=False)
    inner = costs.rendering(renderer, config, size, budget["rays"], setting["scenes"], backward=True)
    works = {
        "encode": costs.encoding(config, size, dtype),
        "conditions": views_rendered,
        "denoise K views": costs.denoising(config, size, setting["views"], dtype),
        "render K views": views_rendered,
        "N inner steps": Work(inner.flops * budget["inner_steps"], inner.bytes * budget["inner_steps"]),
    }
    calls: dict[str, dict[str, Any]] = {part: {} for part in works}
    for name, way in ways.items():
        pieces = {} if isinstance(way, Unavailable) else _pieces(measured, way, method, scenes[0], budget, setting)
        for part in works:
            calls[part][name] = pieces.get(part, way)
    rows = []
    for part, variants in calls.items():
        found = interleaved(variants, measured.device, seconds)
        for name, row in found.items():
            row.name, row.work = f"{part}, {name}", works[part]
        rows += found.values()
    return rows


def _pieces(measured: Subject, way: Way, method: Distillation, one: ViewBatch, budget, setting) -> dict[str, Any]:
    model, cameras = way.model, method.prior(one)

    def encode():
        with torch.no_grad(), measured.autocast():
            return model.encode(one.source, one.source_cameras, one.near, one.far)

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
            field.render(model.renderer, cameras)

    shape = {"rays": budget["rays"], "plane": measured.size} | setting
    return {
        "encode": encode,
        "conditions": conditions,
        "denoise K views": denoise,
        "render K views": render,
        "N inner steps": steps_of(measured, model.renderer, shape, budget["inner_steps"], way.cuda_graphs),
    }


def _work(measured: Subject, budget: dict[str, int], setting: dict[str, int], steps: int) -> Work:
    """Of NGD on all scenes: encoding, conditions, and at every step denoising, rendering and N inner steps."""
    config, size, renderer = measured.config, measured.size, measured.model.renderer
    encoding = costs.encoding(config, size, measured.dtype)
    shown = costs.rendering(renderer, config, size, setting["views"] * size**2, 1, backward=False)
    denoised = costs.denoising(config, size, setting["views"], measured.dtype)
    fitted = costs.rendering(renderer, config, size, budget["rays"], 1, backward=True)

    def total(name: str) -> float:
        once = getattr(encoding, name) + getattr(shown, name)
        inner = budget["inner_steps"] * getattr(fitted, name)
        each = getattr(denoised, name) + getattr(shown, name) + inner
        return setting["scenes"] * (once + steps * each)

    return Work(total("flops"), total("bytes"))


def _arguments(words):
    made = parser(__doc__, sweeps=tuple(SWEEPS))
    made.add_argument("--strategy", choices=STRATEGIES, default="ngd_current")
    made.add_argument("--budget", choices=("minutes", "paper"), default="minutes")
    made.add_argument("--scenes", type=int, default=1, help="distilled in one batch")
    made.add_argument("--steps", type=int, help="diffusion steps to time; default: all of the budget")
    made.add_argument("--extrapolate", action="store_true", help="from --steps to all of the budget's, and say so")
    made.add_argument("--whole", action="store_true", help="objects only, not their parts")
    made.add_argument(
        "--compile", action="store_true", help="also with compiled U-Nets; the first call takes up to minutes"
    )
    arguments = made.parse_args(words)
    if arguments.extrapolate and (arguments.steps or 0) < 2:
        made.error("--extrapolate needs --steps of at least 2")
    return arguments


if __name__ == "__main__":
    main()
