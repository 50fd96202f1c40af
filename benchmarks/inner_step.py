"""One inner step of distillation: rays drawn, rendered, compared, differentiated, and Adam.

    python benchmarks/inner_step.py --model base --device cuda
    python benchmarks/inner_step.py --model tiny --sweep rays

The reference is the plain renderer without a CUDA graph. "coarse kept" draws importance samples from weights that were
found before (strategy.coarse=refresh), as rendering for guidance finds them anyway: the time of that is not counted.
"""

from dataclasses import replace
from itertools import product

import torch

import costs
from harness import Row, Unavailable, Variant, interleaved, parser, settings_of
from nerfdiff.fit.inner_steps import InnerSteps
from nerfdiff.fit.ray_batches import RayBatches
from nerfdiff.render.renderer import Renderer
from render import noise_field, with_samples
from report import Report
from subjects import Subject, scene, subject
from variants import renderers

SWEEPS = {
    "rays": (256, 1024, 4096, 16384),
    "samples": (16, 32, 64, 128, 256),
    "plane": (32, 64, 128, 256, 512),
    "views": (5, 25, 50, 100),
    "scenes": (1, 2, 4, 8),
}


def main(words: list[str] | None = None) -> str:
    arguments = _arguments(words)
    measured = subject(arguments)
    limit = measured.limits(arguments.seconds)
    usual = {
        "rays": arguments.rays,
        "samples": measured.model.renderer.samples_per_ray,
        "plane": measured.size,
        "views": arguments.views,
        "scenes": 1,
    }
    settings = usual | {"steps timed at once": arguments.steps}
    notes = ["times are of one step, those of a run divided by its steps, drawing and all"]
    report = Report("inner_step", measured, limit, settings, arguments.out, notes, arguments.sweep)
    for setting in settings_of(arguments, usual, SWEEPS):
        report.add(_measure(measured, setting, arguments.steps, arguments.seconds))
    return str(report.finish())


def _measure(measured: Subject, setting: dict[str, int], steps: int, seconds: float) -> list[Row]:
    renderer = with_samples(measured.model.renderer, setting["samples"])
    variants: dict[str, Variant] = {}
    for name, found in renderers(measured.model, renderer).items():
        for record, keep in product((False, True), repeat=2):
            label = name + ", CUDA graph" * record + ", coarse kept" * keep
            if isinstance(found, Unavailable):
                variants[label] = found
            elif record and measured.device.type != "cuda":
                variants[label] = Unavailable("needs a CUDA GPU")
            else:
                variants[label] = steps_of(measured, found, setting, steps, record, keep)
    rendered = costs.rendering(renderer, measured.config, setting["plane"], setting["rays"], setting["scenes"], True)
    parameters = setting["scenes"] * 3 * measured.config["field"]["channels"] * setting["plane"] ** 2
    # Adam reads a parameter, its gradient and two moments, and writes all but the gradient
    work = replace(rendered, bytes=rendered.bytes + 7 * costs.NUMBER * parameters)
    rows = interleaved(variants, measured.device, seconds)
    for row in rows.values():
        row.setting, row.work = setting, work
        if row.seconds is not None:
            row.seconds |= {key: row.seconds[key] / steps for key in ("median", "iqr")}
            row.more["steps/s, all scenes"] = setting["scenes"] / row.seconds["median"]
    return list(rows.values())


def steps_of(
    measured: Subject, renderer: Renderer, setting: dict[str, int], steps: int, record: bool, keep: bool = False
) -> Variant:
    """A run of `steps` inner steps on fields of noise; with `keep`, coarse weights are found once, before."""
    field = noise_field(measured, setting["plane"], setting["scenes"])
    views = scene(measured, setting["views"], setting["scenes"])
    batches = RayBatches(views.target_cameras, field.near, field.far)
    batches.set_colours(views.targets)
    if keep:
        with torch.no_grad(), measured.autocast():
            batches.set_coarse(field.render(renderer, views.target_cameras, keep_coarse=True).coarse)
    rates = torch.tensor([5e-2, 1e-4], device=measured.device)
    optimizer = torch.optim.Adam(
        [{"params": [field.planes], "lr": rates[0]}, {"params": list(field.decoder.parameters()), "lr": rates[1]}],
        fused=True,
        capturable=measured.device.type == "cuda",
    )
    generators = [torch.Generator(measured.device).manual_seed(number) for number in range(setting["scenes"])]
    inner = InnerSteps(field, renderer, batches, optimizer, setting["rays"], generators, record)

    def run():
        with measured.autocast():
            inner.run(steps)
        if record and measured.device.type == "cuda" and not inner.recorded:
            raise RuntimeError("the steps could not be recorded as a CUDA graph")

    return run


def _arguments(words):
    made = parser(__doc__, sweeps=tuple(SWEEPS))
    made.add_argument("--rays", type=int, default=4096, help="B, per scene")
    made.add_argument("--views", type=int, default=50, help="K")
    made.add_argument("--steps", type=int, default=16, help="inner steps in one timed call")
    return made.parse_args(words)


if __name__ == "__main__":
    main()
