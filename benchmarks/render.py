"""Rendering rays through a triplane: one whole view, and the forward and backward pass of an inner step's rays.

    python benchmarks/render.py --model base --device cuda
    python benchmarks/render.py --model tiny --sweep samples

Ratios are to the reference backend (plain PyTorch) in the same run.
"""

from dataclasses import replace

import torch

import costs
from harness import Row, Unavailable, Variant, interleaved, parser, settings_of
from nerfdiff.cameras import Rays
from nerfdiff.field.triplane import Triplane
from nerfdiff.fit.ray_batches import RayBatches
from nerfdiff.fit.refined_field import RefinedField
from nerfdiff.render.renderer import Renderer
from report import Report
from subjects import Subject, scene, subject
from variants import renderers

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
        for backward in (False, True):
            report.add(_measure(measured, setting, backward, arguments.seconds))
    return str(report.finish())


def _measure(measured: Subject, setting: dict[str, int], backward: bool, seconds: float) -> list[Row]:
    samples, renderer = setting["samples"], with_samples(measured.model.renderer, setting["samples"])
    field = noise_field(measured, setting["plane"], setting["scenes"])
    rays = random_rays(measured, field, setting["rays"])
    jitter = torch.rand(*rays.near.shape, samples, device=measured.device)
    variants = {
        name: found if isinstance(found, Unavailable) else _pass(measured, found, field, rays, jitter, backward)
        for name, found in renderers(measured.model, renderer).items()
    }
    work = costs.rendering(renderer, measured.config, setting["plane"], setting["rays"], setting["scenes"], backward)
    kind = "forward and backward" if backward else "forward"
    rows = interleaved(variants, measured.device, seconds)
    for name, row in rows.items():
        row.name, row.setting, row.work = f"{name}, {kind}", setting, work
        if row.seconds is not None:
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
    """Of the cameras around each scene."""
    cameras = scene(measured, 8, len(field.planes)).target_cameras
    batches = RayBatches(cameras, field.near, field.far)
    scenes, per_scene = batches.shape
    noise = torch.Generator(measured.device).manual_seed(1)
    return batches.at(torch.randint(per_scene, (scenes, count), generator=noise, device=measured.device))[0]


def _pass(measured: Subject, renderer: Renderer, field: RefinedField, rays: Rays, jitter, backward: bool) -> Variant:
    def forward():
        with torch.no_grad(), measured.autocast():
            renderer.render(field.field(), rays, jitter)

    def both():
        field.zero_grad()
        with measured.autocast():
            renderer.render(field.field(), rays, jitter).rgb.square().sum().backward()

    return both if backward else forward


def _arguments(words):
    made = parser(__doc__, sweeps=tuple(SWEEPS))
    made.add_argument("--rays", type=int, help="per scene; default: one whole view")
    return made.parse_args(words)


if __name__ == "__main__":
    main()
