"""One step of joint training: encode, render whole targets, denoise them, differentiate, AdamW.

    python benchmarks/training_step.py --model base --batch 32 --device cuda
    python benchmarks/training_step.py --model base --memory 80

The reference is the plain renderer and eager U-Nets in PyTorch's own memory layout. `--memory` finds the largest batch
that fits into so many GiB: computed from shapes, and on a GPU also tried.
"""

import copy
from collections.abc import Callable
from dataclasses import replace

import torch
from lightning import Trainer

import costs
from harness import Row, Unavailable, Variant, interleaved, parser, settings_of
from nerfdiff.cli import load_config
from nerfdiff.data.batch import ViewBatch
from nerfdiff.diffusion.layout import channels_last
from nerfdiff.diffusion.unet import AUTO
from nerfdiff.model import NerfDiff
from nerfdiff.render.renderer import Renderer
from nerfdiff.training.memory import largest_batch, within_memory
from nerfdiff.training.module import NerfDiffModule
from nerfdiff.utils.config import plain
from report import Report
from subjects import Subject, scene, subject
from variants import as_kind, kinds, renderers

SWEEPS = {"batch": (1, 2, 4, 8, 16, 32)}


class Alone(NerfDiffModule):
    """The module with a Trainer that does not run: there is nobody to log to."""

    trainer = Trainer(accelerator="cpu", max_steps=500_000, logger=False, enable_checkpointing=False)

    def log(self, *args, **kwargs) -> None:
        pass

    def log_dict(self, *args, **kwargs) -> None:
        pass


def main(words: list[str] | None = None) -> str:
    arguments = _arguments(words)
    cfg = load_config("train", [f"model={arguments.model}", "data=srn_cars", *arguments.overrides])
    usual = {"batch": arguments.batch or cfg.data.batch_size}
    measured = _settled(subject(arguments), cfg, usual["batch"])
    limit = measured.limits(arguments.seconds)
    settings = usual | {"targets": cfg.data.target_views, "checkpointing": measured.config["unet"]["checkpointing"]}
    notes = ["FLOP without what is recomputed: the share of the matrix rate is the model's, not the device's, work"]
    report = Report("training_step", measured, limit, settings, arguments.out, notes, arguments.sweep)
    for setting in settings_of(arguments, usual, SWEEPS):
        report.add(_measure(measured, cfg, setting["batch"], arguments.compile, arguments.seconds))
    if arguments.memory is not None:
        found = largest_batches(measured, cfg, arguments.memory)
        report.settings |= found
        report.notes += [f"{name}: {batch}" for name, batch in found.items()]
    return str(report.finish())


def _settled(measured: Subject, cfg, batch: int) -> Subject:
    """With the recomputing that a training run of this batch would choose here, where that is its to choose."""
    if measured.config["unet"]["checkpointing"] != AUTO:
        return measured
    size = measured.size, measured.size
    step = measured.device, batch, cfg.data.target_views, *size, measured.precision
    config = within_memory(measured.config, *step)
    with measured.device:
        model = NerfDiff(**config).eval()
    model.load_state_dict(measured.model.state_dict())
    return replace(measured, config=config, model=model)


def _measure(measured: Subject, cfg, batch: int, compiled: bool, seconds: float) -> list[Row]:
    views = scene(measured, cfg.data.target_views, batch)
    variants: dict[str, Variant] = {}
    for name, renderer in renderers(measured.model, measured.model.renderer).items():
        # not every kind of U-Net there is: each variant has weights and moments of its own
        for kind in ("eager", kinds(compiled)[-1]):
            runs = not isinstance(renderer, Unavailable)
            variants[f"{name}, {kind}"] = step_of(measured, cfg, views, renderer, kind) if runs else renderer
    work = costs.training(measured.config, measured.size, batch, cfg.data.target_views, measured.dtype)
    rows = interleaved(variants, measured.device, seconds)
    for name, row in rows.items():
        row.setting, row.work = {"batch": batch}, work
        if row.seconds is None:
            continue
        row.more["images/s"] = batch * cfg.data.target_views / row.seconds["median"]
        if measured.device.type == "cuda":
            row.more["peak GiB"] = _peak(measured, variants[name]) / 2**30
    return list(rows.values())


def step_of(measured: Subject, cfg, batch: ViewBatch, renderer: Renderer, kind: str) -> Variant:
    """An optimizer step with the run's settings, but for its schedule and averages, on a copy of the model."""
    made: list[tuple[Alone, torch.optim.Optimizer]] = []

    def step():
        try:
            if not made:
                module = _module(measured, cfg, renderer, kind)
                made.append((module, module.configure_optimizers()["optimizer"]))
            module, optimizer = made[0]
            with measured.autocast():
                loss = module.training_step(batch, 0)
            loss.backward()
            optimizer.step()
            optimizer.zero_grad()
        except torch.OutOfMemoryError:
            made.clear()  # others may have room
            raise

    return step


def _module(measured: Subject, cfg, renderer: Renderer, kind: str) -> Alone:
    with torch.device("meta"):  # its own model is replaced
        module = Alone(
            model=measured.config,
            losses=plain(cfg.losses),
            optimizer=plain(cfg.optimizer),
            validation_times=[0.5],
            channels_last=False,
            seed=0,
        )
    module.model = as_kind(copy.deepcopy(measured.model).train().requires_grad_(True), kind)
    module.model.renderer = renderer
    return module.to(measured.device)


def _peak(measured: Subject, step: Callable[[], None]) -> int:
    """Bytes that a step takes on a GPU where it is alone: other variants' weights and moments are not its own."""
    resident = torch.cuda.memory_allocated(measured.device)
    torch.cuda.reset_peak_memory_stats(measured.device)
    step()
    weights_and_moments = 3 * sum(parameter.nbytes for parameter in measured.model.parameters())
    return torch.cuda.max_memory_allocated(measured.device) - resident + weights_and_moments


def largest_batches(measured: Subject, cfg, gib: float) -> dict[str, int]:
    """Find the largest batch that fits: computed, and on a GPU tried."""
    memory, views, size = int(gib * 2**30), cfg.data.target_views, measured.size
    computed = largest_batch(measured.config, memory, views, size, size, measured.precision)
    found = {f"largest batch in {gib:g} GiB, computed in {measured.precision}": computed}
    if measured.device.type == "cuda":
        found[f"largest batch on this GPU, tried in {measured.precision}"] = largest(
            lambda batch: _fits(measured, cfg, batch)
        )
    return found


def largest(fits: Callable[[int], bool]) -> int:
    """The largest number that fits where all smaller ones do: doubled, then halved between."""
    low, high = 0, 1
    while fits(high):
        low, high = high, 2 * high
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if fits(middle) else (low, middle)
    return low


def _fits(measured: Subject, cfg, batch: int) -> bool:
    """Return true if two steps run beside an average of the weights: Adam's moments come with the first."""
    renderer = replace(measured.model.renderer, backend="auto")
    kind = "channels_last" if channels_last(None, measured.device, False) else "eager"  # a run's own choice
    try:
        step = step_of(measured, cfg, scene(measured, cfg.data.target_views, batch), renderer, kind)
        average = [parameter.clone() for parameter in measured.model.parameters()]
        step()
        step()
        del average
    except torch.OutOfMemoryError:
        return False
    finally:
        torch.cuda.empty_cache()
    return True


def _arguments(words):
    made = parser(__doc__, sweeps=tuple(SWEEPS))
    made.add_argument("--batch", type=int, help="draws per step; default: the training config's")
    made.add_argument(
        "--compile", action="store_true", help="also with compiled U-Nets; the first call takes up to minutes"
    )
    made.add_argument("--memory", type=float, metavar="GIB", help="also find the largest batch")
    return made.parse_args(words)


if __name__ == "__main__":
    main()
