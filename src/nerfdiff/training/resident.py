"""Training with all images on the device and one CUDA graph per step.

A small model's step on a GPU takes as long as the host needs to start its kernels. Here nothing is asked of the host:
images and draws lie on the device, noise and times are made there, so a step is one graph that is replayed. On a CPU
the same steps run one by one. The loss is `NerfDiffModule`'s; what is left out is what a run of minutes can do without:
resuming, validation, previews (evaluate.py does these afterwards, on the snapshots too).
"""

import gc
import logging
import math
import time
from collections.abc import Mapping
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path

import torch
import torch.nn.functional as F
from hydra.utils import instantiate
from jaxtyping import Int64
from omegaconf import DictConfig
from torch import Tensor
from torch.nn.utils import clip_grad_norm_
from torch.utils.tensorboard import SummaryWriter

from nerfdiff.averages import PowerAverages
from nerfdiff.checkpoint import load_model
from nerfdiff.compilation import compile_unets
from nerfdiff.data.cache import CachedReader
from nerfdiff.diffusion.denoiser import Condition
from nerfdiff.diffusion.schedule import add_noise, alpha_sigma, expand, v_from_x0_eps
from nerfdiff.exported_model import DTYPES, LoadedModel, export_model
from nerfdiff.model import NerfDiff
from nerfdiff.results.environment import git_state
from nerfdiff.training.resident_scenes import FrozenField, ResidentScenes, draw_table
from nerfdiff.training.run import plain
from nerfdiff.utils.errors import ConfigError, TrainingDiverged
from nerfdiff.utils.images import to_signed
from nerfdiff.utils.randomness import seed_of, spread_times

log = logging.getLogger(__name__)


class Step:
    """One optimizer step; `run` makes it, and on a GPU replays it.

    Args:
        table: draws, `batch` of them a step.
        frozen: what a field that is not trained shows; None trains field and CDM together.
        optimizer: AdamW's `lr`, `weight_decay` and `betas`.
        clip: largest norm of the gradient.
        autocast: the context of the forward pass.
    """

    def __init__(
        self,
        model: NerfDiff,
        scenes: ResidentScenes,
        table: Int64[Tensor, "draws columns"],
        batch: int,
        frozen: FrozenField | None,
        optimizer: Mapping,
        clip: float,
        seed: int,
        autocast: AbstractContextManager,
    ):
        self.model, self.scenes, self.frozen, self.seed = model, scenes, frozen, seed
        self.clip, self.autocast = clip, autocast
        device = scenes.pixels.device
        self.table = table.to(device).view(-1, batch, table.shape[1])
        self.number = torch.zeros(1, dtype=torch.int64, device=device)
        self.lr = torch.tensor(float(optimizer["lr"]), device=device)
        self.trained = [p for p in model.parameters() if p.requires_grad]
        cuda = device.type == "cuda"
        self.optimizer = torch.optim.AdamW(
            self.trained,
            lr=self.lr if cuda else float(optimizer["lr"]),
            weight_decay=optimizer["weight_decay"],
            betas=tuple(optimizer["betas"]),
            fused=cuda,
            capturable=cuda,
        )
        self.losses = {name: torch.zeros((), device=device) for name in ("loss_dm", "loss_ic")}
        self.taken = 0
        self._graph: torch.cuda.CUDAGraph | None = None

    def capture(self, warm_up: int = 3) -> None:
        """Record the step, after some that are made one by one; they count as steps.

        All on one stream: autograd's nodes that add up gradients run on the stream on which they were made, and one
        that is left of a step on the default stream breaks the recording. Hence no cycles that keep them, either.

        Raises:
            RuntimeError: it cannot be recorded; steps can be made one by one as before.
        """
        gc.collect()
        here, aside = torch.cuda.current_stream(), torch.cuda.Stream()
        aside.wait_stream(here)
        graph = torch.cuda.CUDAGraph()
        try:
            with torch.cuda.stream(aside):
                for _ in range(warm_up):
                    self._step()
                self.optimizer.zero_grad(set_to_none=True)
                with torch.cuda.graph(graph, stream=aside, capture_error_mode="thread_local"):
                    self._step(recorded=True)
        except RuntimeError:
            torch.cuda.synchronize()
            # the generator still takes itself for recorded, and would refuse to draw
            index = self.number.device.index or 0
            fresh = torch.Generator(self.number.device).manual_seed(seed_of(self.seed, "not recorded"))
            torch.cuda.default_generators[index].graphsafe_set_state(fresh)
            raise
        finally:
            here.wait_stream(aside)
        self._graph = graph

    def run(self, lr: float) -> None:
        """Make one step with this learning rate."""
        if self.lr.is_cuda:
            self.lr.fill_(lr)
        else:
            self.optimizer.param_groups[0]["lr"] = lr
        if self._graph is None:
            self._step()
        else:
            self._graph.replay()
            self.taken += 1

    def _step(self, recorded: bool = False) -> None:
        if not recorded:
            self.optimizer.zero_grad(set_to_none=True)
            self.taken += 1
        with self.autocast:
            losses = self._losses(self.table[self.number % len(self.table)][0])
        sum(losses.values()).backward()
        clip_grad_norm_(self.trained, self.clip, foreach=True)
        self.optimizer.step()
        for name, value in losses.items():
            self.losses[name].copy_(value.detach())
        self.number.add_(1)

    def _losses(self, rows: Int64[Tensor, "batch columns"]) -> dict[str, Tensor]:
        """Compute L^DM, and L^IC where the field is trained (paper, "Training phase")."""
        scene, source, targets = rows[:, 0], rows[:, 1], rows[:, 2:]
        scenes, model = self.scenes, self.model
        truth = scenes.images(scene[:, None].expand_as(targets), targets)
        own, relative = scenes.cameras(scene, source, targets)
        losses = {}
        if self.frozen is None:
            encoding = model.encode_images(scenes.images(scene, source), own, scenes.near[scene], scenes.far[scene])
            rays = math.prod(targets.shape[1:]) * math.prod(truth.shape[-2:])
            jitter = torch.rand(len(rows), rays, model.renderer.samples_per_ray, device=truth.device)
            rendered = model.render(encoding, relative, jitter).images
            losses["loss_ic"] = F.mse_loss(rendered, truth)
            condition = model.condition(encoding, relative, rendered)
        else:
            every = targets.shape[1]
            condition = Condition(
                rendered=self.frozen.rendered[scene[:, None], source[:, None], targets].float().flatten(0, 1),
                source=scenes.images(scene, source)[:, None].expand_as(truth).flatten(0, 1),
                cameras=relative.flatten(),
                near=scenes.near[scene].repeat_interleave(every),
                context=[level[scene, source] for level in self.frozen.context],
            )
        x0 = to_signed(truth.flatten(0, 1))
        eps = torch.randn_like(x0)
        t = spread_times(self.number * len(x0) + torch.arange(len(x0), device=x0.device), self.seed)
        alpha, sigma = (expand(c, x0) for c in alpha_sigma(t))
        predicted = model.denoiser.velocity(add_noise(x0, eps, alpha, sigma), t, condition)
        return losses | {"loss_dm": F.mse_loss(predicted, v_from_x0_eps(x0, eps, alpha, sigma))}


def train_resident(cfg: DictConfig) -> Path:
    """Train for `cfg.minutes` or `cfg.steps`, whichever ends first, from `cfg.init`.

    Returns:
        the exported weights: the average of `cfg.average`.

    Raises:
        UserError: data, config or checkpoint that do not fit, or weights that are no longer finite.
    """
    _check(cfg)
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    begun = load_model(cfg.init, "ema", cfg.paths.assets_dir)
    model = _model(cfg, begun).to(device).train()
    data = instantiate(cfg.data)
    reader = data.reader("train")
    if data.cache:
        reader = CachedReader(reader, data.cache_dir, f"{data.name}_{data.splits['train']}")
    scenes = ResidentScenes.read(reader, data.train_scenes, device)
    count, views, _, *size = scenes.pixels.shape
    log.info("%d scenes of %d views of %dx%d pixels on %s", count, views, *size, device)
    sources = data.train_source_views or views
    table = draw_table(
        seed=cfg.seed,
        draws=min(cfg.steps, cfg.table) * data.batch_size,
        scenes=count,
        views=views,
        targets=data.target_views,
        sources=sources,
        source_as_target=data.source_as_target,
    )
    autocast = torch.autocast(device.type, torch.bfloat16, enabled=cfg.precision == "bf16-mixed", cache_enabled=False)
    frozen = None
    if cfg.part == "cdm":
        model.encoder.requires_grad_(False)
        model.decoder.requires_grad_(False)
        began = time.monotonic()
        frozen = FrozenField(model, scenes, sources, cfg.encoded_at_once, autocast, cfg.every_seconds)
        log.info("%d renderings kept, %.1f s", frozen.rendered[..., 0, 0, 0].numel(), time.monotonic() - began)
    compile_unets(model, cfg.compile, cfg.paths.compiled_dir)
    torch.backends.cudnn.benchmark = cfg.benchmark
    step = Step(
        model, scenes, table, data.batch_size, frozen, plain(cfg.optimizer), cfg.gradient_clip_val, cfg.seed, autocast
    )
    averages = PowerAverages(list(cfg.lengths))
    _train(cfg, step, averages)
    with torch.no_grad():
        for parameter, value in zip(model.parameters(), averages.values[str(cfg.average)], strict=True):
            parameter.copy_(value)
    seen = {
        "part": "CDM" if cfg.part == "cdm" else "field and the CDM",
        "images": step.taken * data.batch_size * data.target_views,
        "dataset": data.name,
        "scenes": count,
        "about": data.about,
        "git_sha": git_state(Path(__file__).parent)["git_sha"],
        "average": cfg.average,
    }
    loaded = replace(
        begun,
        model=model.cpu().eval(),
        config=dict(begun.config) | {"conditioning": plain(cfg.conditioning)},
        image_size=list(size),
        stability={},
        trained_on=[*begun.trained_on, seen],
    )
    return export_model(loaded, Path(cfg.paths.output_dir) / "model", DTYPES[cfg.dtype])


def _check(cfg: DictConfig) -> None:
    """Raise ConfigError for settings that are found wrong only after training, or that training from memory lacks."""
    if cfg.part not in ("cdm", "joint"):
        raise ConfigError(f"part={cfg.part}: choose cdm (the field stays as it is) or joint")
    if cfg.precision not in ("bf16-mixed", "32-true"):
        raise ConfigError(f"precision={cfg.precision}: choose bf16-mixed or 32-true")
    if cfg.dtype not in DTYPES:
        raise ConfigError(f"dtype={cfg.dtype}: choose {', '.join(DTYPES)}")
    if cfg.optimizer.decay not in ("none", "cosine"):
        raise ConfigError(f"optimizer.decay must be none or cosine, got {cfg.optimizer.decay!r}")
    if cfg.average not in cfg.lengths:
        raise ConfigError(f"average={cfg.average} is none of the lengths={list(cfg.lengths)} that are kept")
    if not cfg.snapshots or not all(0 < share <= 1 for share in cfg.snapshots):
        raise ConfigError(f"snapshots={list(cfg.snapshots)}: expected shares of the training, above 0, at most 1")
    for key in ("train_source_view", "source_target_noise"):
        if cfg.data[key]:
            raise ConfigError(f"data.{key}={cfg.data[key]}: training from memory does not know it; use train.py")


def _model(cfg: DictConfig, begun: LoadedModel) -> NerfDiff:
    """Build a model of the sizes of `init`, with its field, and with its CDM unless that is to begin afresh."""
    torch.manual_seed(cfg.seed)
    sizes = dict(begun.config)
    render = {**sizes["render"], "backend": cfg.backend}
    model = NerfDiff(**sizes | {"render": render, "conditioning": plain(cfg.conditioning)})
    begins = begun.model.state_dict()
    if cfg.fresh_cdm:
        begins = {n: v for n, v in begins.items() if not n.startswith("denoiser.")}
        begins |= {n: v for n, v in model.state_dict().items() if n.startswith("denoiser.")}
    try:
        model.load_state_dict(begins)
    except RuntimeError as error:  # of other names or sizes
        raise ConfigError(
            f"init={cfg.init} has another CDM than conditioning={cfg.conditioning.name} needs: set fresh_cdm=true to "
            "begin with a new one"
        ) from error
    if cfg.channels_last:
        model.to(memory_format=torch.channels_last)
    return model


def _train(cfg: DictConfig, step: Step, averages: PowerAverages) -> None:
    """Make steps until the time or their number is over, and save averages on the way."""
    options, output = plain(cfg.optimizer), Path(cfg.paths.output_dir)
    names, parameters = zip(*step.model.named_parameters(), strict=True)
    marks = sorted(cfg.snapshots)
    began = said = time.monotonic()
    with SummaryWriter(output / "tensorboard") as curves:
        while True:
            done = max(step.taken / cfg.steps, (time.monotonic() - began) / (60 * cfg.minutes))
            if marks and done >= marks[0] and step.taken:
                averages.save(output / "snapshots", names, step.taken)
                marks = [mark for mark in marks if mark > done]
            if done >= 1 and step.taken:
                break
            fall = 0.5 * (1 + math.cos(math.pi * min(1.0, done))) if options["decay"] == "cosine" else 1.0
            step.run(options["lr"] * fall * min(1.0, (step.taken + 1) / max(1, options["warmup_steps"])))
            averages.update(parameters, step.taken)
            if _records(step) and step.taken == cfg.eager_steps:
                try:
                    step.capture()
                except RuntimeError as error:
                    log.warning("the step is not recorded, and made kernel by kernel: %s", _causes(error))
            if step.taken % cfg.log_every_n_steps == 0:  # reading the losses waits for the device: steps do not pile up
                losses = {name: value.item() for name, value in step.losses.items()}
                if not all(map(math.isfinite, losses.values())):
                    raise TrainingDiverged(f"step {step.taken}: the loss is not finite; lower optimizer.lr")
                for name, value in losses.items():
                    curves.add_scalar(f"train/{name}", value, step.taken)
                if (now := time.monotonic()) - said > cfg.every_seconds or step.taken == cfg.log_every_n_steps:
                    words = ", ".join(f"{name} {value:.4f}" for name, value in losses.items())
                    rate = step.taken / (now - began)
                    log.info("step %d, %s, %.1f steps/s, %.0f %% done", step.taken, words, rate, 100 * done)
                    said = now


def _records(step: Step) -> bool:
    """Return true where CUDA graphs are."""
    return step.number.is_cuda


def _causes(error: BaseException | None) -> str:
    """Name the errors that led to this one, first things first: the end of a broken recording hides what broke it."""
    lines: list[str] = []
    while error is not None:
        lines.append((str(error).splitlines() or [type(error).__name__])[0])
        error = error.__cause__ or error.__context__
    return "; then ".join(reversed(lines))
