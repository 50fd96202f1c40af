"""The paper's table of speed: encoding an image and rendering a view, by triplanes and by pixel-aligned NeRFs.

    python benchmarks/field_speed.py --device cuda
    python benchmarks/field_speed.py --rays 1024        # on a CPU, of the 16384 of a view
    python benchmarks/field_speed.py --models tiny      # at demo scale

pixelNeRF and VisionNeRF have their authors' sizes, and the same renderer and samples as the triplanes: what differs is
what is evaluated at a point. All are timed in one run; ratios are to the first model, in plain PyTorch
as the pixel-aligned ones are rendered.
"""

import argparse
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch

import costs
from harness import Row, Variant, Work, interleaved, parser
from nerfdiff.cameras import Rays
from nerfdiff.cli import choices
from nerfdiff.data.batch import ViewBatch
from nerfdiff.field.encoder import Encoding
from nerfdiff.field.kinds import TRIPLANE
from nerfdiff.render.renderer import Renderer
from report import Report
from subjects import Subject, scene, subject

NAMES = {"pixelnerf": "pixelNeRF", "visionnerf": "VisionNeRF"}
TRIPLANES = {"base": "NerfDiff-B", "large": "NerfDiff-L"}
PAPER = {
    "pixelNeRF": (0.007, 1.639),
    "VisionNeRF": (0.015, 0.678),
    "NerfDiff-B": (0.024, 0.018),
    "NerfDiff-L": (0.031, 0.018),
}
"""Seconds to encode and to render (paper, table "Comparison of encoding and rendering speed"); its GPU is not named."""


def main(words: list[str] | None = None) -> str:
    arguments = _arguments(words)
    subjects = _subjects(arguments)
    first = next(iter(subjects.values()))
    limit = first.limits(arguments.seconds)
    samples = {s.model.renderer.samples_per_ray for s in subjects.values()}
    settings = {"pixels": first.size**2, "rays": arguments.rays or first.size**2, "samples": sorted(samples)}
    notes = [
        "render: seconds of a whole view, in proportion where fewer of its rays were rendered",
        "pixelNeRF and VisionNeRF render by two MLPs, at 64 + 96 and 64 + 128 points of a ray; here one, as a triplane",
        "paper: 128 pixels, a GPU that is not named",
    ]
    report = Report("field_speed", first, limit, settings, arguments.out, notes)
    report.add(_encoding(subjects, arguments.seconds))
    report.add(_rendering(subjects, arguments.rays, arguments.seconds))
    return str(report.finish())


def _subjects(arguments: argparse.Namespace) -> dict[str, Subject]:
    """By name, the triplane models first; of their diffusion models nothing but the sizes is kept."""
    wanted = {TRIPLANES.get(model, f"triplane, {model}"): (model, TRIPLANE) for model in arguments.models}
    others = [field for field in choices("field") if field != TRIPLANE]
    wanted |= {NAMES.get(field, field): (arguments.models[0], field) for field in others}
    made = {}
    for name, (model, field) in wanted.items():
        overrides = [f"field={field}", *arguments.overrides]
        own = subject(argparse.Namespace(**vars(arguments) | {"model": model, "overrides": overrides}))
        own.model.denoiser.to("meta")
        made[name] = replace(own, name="-".join(arguments.models))
    return made


def _encoding(subjects: dict[str, Subject], seconds: float) -> list[Row]:
    variants = {name: _without_gradients(own, lambda own=own: _encode(own)) for name, own in subjects.items()}
    rows = interleaved(variants, next(iter(subjects.values())).device, seconds)
    for name, row in rows.items():
        own = subjects[name]
        row.setting, row.work = {"part": "encode"}, costs.encoding(own.config, own.size, own.dtype)
        row.more = _slower(row) | _beside(name, 0) | {"M parameters": own.model.parameter_count()["encoder"] / 1e6}
    return list(rows.values())


def _rendering(subjects: dict[str, Subject], count: int | None, seconds: float) -> list[Row]:
    variants: dict[str, Variant] = {}
    measured: dict[str, str] = {}
    for name, own in subjects.items():
        renderers = {name: own.model.renderer}
        if own.model.field_name == TRIPLANE:
            # what kernels, or a CPU's own form of the field, bring is not what the triplane brings: the reference
            renderers = {f"{name}, plain PyTorch": replace(own.model.renderer, backend="torch")} | renderers
        encoding, rays = _without_gradients(own, lambda own=own: _encode(own))(), _rays(own, count)
        for variant, renderer in renderers.items():
            measured[variant] = name
            variants[variant] = _without_gradients(own, _render(own, renderer, encoding, rays))
    rows = interleaved(variants, next(iter(subjects.values())).device, seconds)
    for variant, row in rows.items():
        own = subjects[measured[variant]]
        rays = count or own.size**2
        row.setting, row.work = {"part": "render"}, rendering_work(own, rays)
        row.more = _slower(row) | (_beside(measured[variant], 1) if variant in subjects else {})
        row.more["M parameters"] = own.model.parameter_count()["decoder"] / 1e6
        if row.seconds is not None:
            row.more["s per view"] = row.seconds["median"] * own.size**2 / rays
    return list(rows.values())


def rendering_work(measured: Subject, rays: int) -> Work:
    """Count the work of rendering one scene's rays: as `costs.rendering`, the gathers and layers being the field's own.

    A pixel-aligned field's point takes one bilinear gather (4 taps, a multiplication and an addition each) of all
    channels, and every weight of the MLP once, but for those of layers that work on whole maps before.
    """
    model = measured.model
    if model.field_name == TRIPLANE:
        return costs.rendering(model.renderer, measured.config, measured.size, rays, 1, backward=False)
    encoding = _without_gradients(measured, lambda: _encode(measured))()
    field = _without_gradients(measured, lambda: model.field(encoding))()
    on_points, on_maps = sum(p.numel() for p in model.decoder.parameters() if p.ndim == 2), 0
    for before, after, weight in zip(encoding.features.maps, field.features.maps, field.weights, strict=True):
        if weight is None:
            on_points -= before.shape[1] * after.shape[1]
            on_maps += before.shape[1] * after.numel()
    gathered = sum(one.shape[1] for one in field.features.maps)
    points = model.renderer.samples_per_ray * rays
    numbers = [*encoding.features.maps, *model.decoder.parameters()]
    moved = sum(one.numel() for one in numbers) + rays * (8 + 5)
    return Work((4 * 2 * gathered + 2 * on_points) * points + 2 * on_maps, costs.NUMBER * moved)


def _views(measured: Subject) -> ViewBatch:
    return scene(measured, 1)


def _encode(measured: Subject) -> Encoding:
    views = _views(measured)
    return measured.model.encode(views)


def _rays(measured: Subject, count: int | None) -> Rays:
    """Return rays of another view, all or so many spread over it."""
    views = _views(measured)
    rays = views.target_cameras.rays(views.near[:, None], views.far[:, None])
    chosen = torch.randperm(measured.size**2, generator=torch.Generator().manual_seed(0))[:count]
    return Rays(*(part.flatten(1, 3)[:, chosen.to(part.device)] for part in vars(rays).values()))


def _render(measured: Subject, renderer: Renderer, encoding: Encoding, rays: Rays) -> Callable[[], Any]:
    return lambda: renderer.render(measured.model.field(encoding), rays)


def _without_gradients(measured: Subject, call: Callable[[], Any]) -> Callable[[], Any]:
    def called():
        with torch.no_grad(), measured.autocast():
            return call()

    return called


def _slower(row: Row) -> dict[str, float]:
    """Divide a field's seconds by the reference's."""
    return {} if row.ratio is None else {"s / ref.": 1 / row.ratio}


def _beside(name: str, column: int) -> dict[str, float]:
    """The paper's seconds, and how many times those of its NerfDiff-B that is."""
    if name not in PAPER:
        return {}
    seconds = PAPER[name][column]
    return {"paper, s": seconds, "paper, / ref.": seconds / PAPER["NerfDiff-B"][column]}


def _arguments(words):
    made = parser(__doc__)
    made.set_defaults(model="base")
    made.add_argument(
        "--models", nargs="+", choices=choices("model"), default=["base", "large"], help="of the triplanes"
    )
    made.add_argument("--rays", type=int, help="of the view, rendered at a time; default: all")
    arguments = made.parse_args(words)
    if arguments.ckpt is not None or arguments.model != "base":
        made.error("there are several models here, with random weights: choose them with --models")
    return arguments


if __name__ == "__main__":
    main()
