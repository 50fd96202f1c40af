"""Rendering rays through a triplane: one whole view, as many scattered rays and back, and an inner step.

    python benchmarks/render.py --model base --device cuda --within 60
    python benchmarks/render.py --model tiny --sweep samples

Ratios are to the reference backend (plain PyTorch) in the same run. Each number is printed as soon as it is measured.
"""

import time
from dataclasses import replace

import torch

import costs
from harness import DEADLINE, Row, Unavailable, Variant, interleaved, parser, settings_of
from nerfdiff.cameras import Rays
from nerfdiff.field.triplane import Triplane
from nerfdiff.fit.ray_batches import RayBatches
from nerfdiff.fit.refined_field import RefinedField
from nerfdiff.render.renderer import Renderer
from report import Report, duration
from subjects import Subject, scene, subject
from variants import renderers

VIEW, FORWARD, BACKWARD, STEP = WAYS = "one view", "forward", "forward and backward", "inner step"
"""The timed calls; the first and the last do not use `rays`."""
INNER, STEPS = {"rays": 4096, "views": 50}, 16
"""B and K of an inner step; inner steps per timed call on a GPU, where they are replayed from a CUDA graph."""
SWEEPS = {
    "rays": (256, 1024, 4096, 16384, 65536),
    "samples": (16, 32, 64, 128, 256),
    "plane": (32, 64, 128, 256, 512),
    "scenes": (1, 2, 4, 8),
}


def main(words: list[str] | None = None) -> str:
    arguments = _arguments(words)
    measured = subject(arguments)
    limit = measured.limits(arguments.seconds)
    usual = {
        "rays": arguments.rays or measured.size**2,
        "samples": measured.model.renderer.samples_per_ray,
        "plane": measured.size,
        "scenes": 1,
    }
    notes = ["FLOP of the gathers and the decoder, without recomputing; MB is the least that must move"]
    report = Report("render", measured, limit, usual, arguments.out, notes, arguments.sweep)
    for setting in settings_of(arguments, usual, SWEEPS):
        for way in WAYS if arguments.sweep is None else (FORWARD, BACKWARD):
            rows = _measure(measured, setting, way, arguments.seconds)
            for row in rows:
                print(f"{row.name}: {row.reason or duration(row.seconds['median'])}", flush=True)
            report.add(rows)
    return str(report.finish())


def _measure(measured: Subject, setting: dict[str, int], way: str, seconds: float) -> list[Row]:
    renderer = with_samples(measured.model.renderer, setting["samples"])
    if way in (VIEW, STEP):
        setting = setting | {"rays": measured.size**2 if way == VIEW else INNER["rays"]}
    pass_of = {VIEW: _view, STEP: _step}.get(way, _scattered)
    variants = {
        name: found if isinstance(found, Unavailable) else pass_of(measured, found, setting, way)
        for name, found in renderers(measured.model, renderer).items()
    }
    backward = way in (BACKWARD, STEP)
    work = costs.rendering(renderer, measured.config, setting["plane"], setting["rays"], setting["scenes"], backward)
    rows = interleaved(variants, measured.device, seconds)
    for name, row in rows.items():
        row.name, row.setting, row.work = f"{name}, {way}", setting, work
        if row.seconds is not None:
            if way == STEP:
                row.seconds |= {key: row.seconds[key] / steps_at_once(measured) for key in ("median", "iqr")}
            row.more["rays/s"] = setting["rays"] * setting["scenes"] / row.seconds["median"]
    return list(rows.values())


def with_samples(renderer: Renderer, samples: int) -> Renderer:
    """Half of them, or one less, drawn by importance."""
    return replace(renderer, uniform_samples=samples - samples // 2, importance_samples=samples // 2)


def noise_field(measured: Subject, plane: int, scenes: int) -> RefinedField:
    """Planes of noise with the model's decoder."""
    views = scene(measured, 1, scenes)
    channels = measured.config["field"]["channels"]
    noise = torch.Generator(measured.device).manual_seed(0)
    planes = torch.randn(scenes, 3, channels, plane, plane, generator=noise, device=measured.device)
    return RefinedField(Triplane(planes, views.source_cameras, views.near, views.far), measured.model.decoder)


def random_rays(measured: Subject, field: RefinedField, count: int) -> Rays:
    """Draw rays of the cameras around each scene."""
    cameras = scene(measured, 8, len(field.planes)).target_cameras
    batches = RayBatches(cameras, field.near, field.far)
    scenes, per_scene = batches.shape
    noise = torch.Generator(measured.device).manual_seed(1)
    return batches.at(torch.randint(per_scene, (scenes, count), generator=noise, device=measured.device))[0]


def _view(measured: Subject, renderer: Renderer, setting: dict[str, int], way: str) -> Variant:
    field = noise_field(measured, setting["plane"], setting["scenes"])
    cameras = scene(measured, 1, setting["scenes"]).target_cameras

    def view():
        with torch.no_grad(), measured.autocast():
            field.render(renderer, cameras)

    return view


def _step(measured: Subject, renderer: Renderer, setting: dict[str, int], way: str) -> Variant:
    from inner_step import steps_of  # which takes its fields from here

    return steps_of(measured, renderer, setting | INNER, steps_at_once(measured), record=measured.device.type == "cuda")


def steps_at_once(measured: Subject) -> int:
    """Return the inner steps per timed call."""
    return STEPS if measured.device.type == "cuda" else 1


def _scattered(measured: Subject, renderer: Renderer, setting: dict[str, int], way: str) -> Variant:
    field = noise_field(measured, setting["plane"], setting["scenes"])
    rays = random_rays(measured, field, setting["rays"])
    jitter = torch.rand(*rays.near.shape, renderer.samples_per_ray, device=measured.device)

    def forward():
        with torch.no_grad(), measured.autocast():
            renderer.render(field.field(), rays, jitter)

    def both():
        field.zero_grad()
        with measured.autocast():
            renderer.render(field.field(), rays, jitter).rgb.square().sum().backward()

    return both if way == BACKWARD else forward


def _arguments(words):
    made = parser(__doc__, sweeps=tuple(SWEEPS))
    made.add_argument("--rays", type=int, help="per scene, of those that are scattered; default: as many as of a view")
    made.add_argument("--within", type=float, metavar="SECONDS", help="of all; then report what is there")
    arguments = made.parse_args(words)
    if arguments.within is not None:
        DEADLINE.set(str(time.time() + arguments.within))
    return arguments


if __name__ == "__main__":
    main()
