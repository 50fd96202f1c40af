"""The U-Nets: encoding one image, and denoising K views of it.

    python benchmarks/unet.py --model base --device cuda
    python benchmarks/unet.py --model tiny --sweep views

The reference is eager, in PyTorch's own memory layout, with cross-attention's keys computed at every call.
"""

from dataclasses import replace

import torch

import costs
from harness import Row, Variant, interleaved, parser, settings_of
from nerfdiff.utils.images import to_signed
from report import Report
from subjects import Subject, scene, subject
from variants import models

SWEEPS = {"views": (1, 2, 4, 8, 16, 32, 50)}


def main(words: list[str] | None = None) -> str:
    arguments = _arguments(words)
    measured = subject(arguments)
    limit = measured.limits(arguments.seconds)
    notes = ["MB is what operators read and write one by one; fused ones move less"]
    usual = {"views": arguments.views}
    report = Report("unet", measured, limit, usual, arguments.out, notes, arguments.sweep)
    if arguments.sweep is None:
        report.add(_encoder(measured, arguments.compile, arguments.seconds))
    for setting in settings_of(arguments, usual, SWEEPS):
        report.add(_denoiser(measured, setting["views"], arguments.compile, arguments.seconds))
    return str(report.finish())


@torch.no_grad()
def _encoder(measured: Subject, compiled: bool, seconds: float) -> list[Row]:
    one = scene(measured, 1)
    inputs = to_signed(one.source)

    def encode(unet) -> Variant:
        @torch.no_grad()
        def call():
            with measured.autocast():
                unet(inputs)

        return call

    found = models(measured.model, compiled)
    variants = {name: encode(model.encoder.unet) for name, model in found.items()}
    rows = interleaved(variants, measured.device, seconds)
    work = costs.encoding(measured.config, measured.size, measured.dtype)
    for name, row in rows.items():
        row.name, row.setting, row.work = f"encoder, {name}", {"views": 1}, work
        if row.seconds is not None:
            row.more["images/s"] = 1 / row.seconds["median"]
    return list(rows.values())


@torch.no_grad()
def _denoiser(measured: Subject, views: int, compiled: bool, seconds: float) -> list[Row]:
    model, one = measured.model, scene(measured, views)
    with measured.autocast():
        encoding = model.encode(one)
        settled = model.with_keys_values(encoding)
    shown = torch.rand(1, views, 3, measured.size, measured.size, device=measured.device)
    condition = model.condition(encoding, one.target_cameras, shown)
    z = torch.randn(views, 3, measured.size, measured.size, device=measured.device)
    t = torch.full((views,), 0.5, device=measured.device)

    def denoise(denoiser, seen) -> Variant:
        @torch.no_grad()
        def call():
            with measured.autocast():
                denoiser(z, t, seen)

        return call

    found = {name: model.denoiser for name, model in models(model, compiled).items()}
    once = replace(condition, context=settled.context)
    variants = {"eager": denoise(found["eager"], condition)}
    variants |= {f"{name}, keys kept": denoise(network, once) for name, network in found.items()}
    rows = interleaved(variants, measured.device, seconds)
    work = costs.denoising(measured.config, measured.size, views, measured.dtype)
    for name, row in rows.items():
        row.name, row.setting, row.work = f"CDM, {name}", {"views": views}, work
        if row.seconds is not None:
            row.more["images/s"] = views / row.seconds["median"]
    return list(rows.values())


def _arguments(words):
    made = parser(__doc__, sweeps=tuple(SWEEPS))
    made.add_argument("--views", type=int, default=50, help="K")
    made.add_argument("--compile", action="store_true", help="also compiled; the first call takes up to minutes")
    return made.parse_args(words)


if __name__ == "__main__":
    main()
