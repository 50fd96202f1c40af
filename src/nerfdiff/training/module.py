"""Joint training of the single-image NeRF and the CDM (paper, "Training Phase")."""

import hashlib
import math
from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Float
from lightning import LightningModule
from torch import Tensor
from torch.nn.utils import clip_grad_norm_
from torch.optim import Optimizer

from nerfdiff.cameras import Rays
from nerfdiff.data.batch import ViewBatch
from nerfdiff.diffusion.denoiser import Condition
from nerfdiff.diffusion.schedule import add_noise, alpha_sigma, expand, v_from_x0_eps
from nerfdiff.field.encoder import Encoding
from nerfdiff.field.triplane import Triplane
from nerfdiff.metrics.image import psnr, psnr_of_mse
from nerfdiff.model import NerfDiff
from nerfdiff.results.environment import git_state
from nerfdiff.training.callbacks.progress import share_of_time, timer_of
from nerfdiff.training.kept_renderings import KeptRenderings
from nerfdiff.utils.errors import ConfigError
from nerfdiff.utils.images import to_signed
from nerfdiff.utils.randomness import generator, spread_times

WHOLE = {"ray_share": 1.0, "through_rendering": True}
"""The paper's joint loss; checkpoints from before there was another have no such settings."""


class NerfDiffModule(LightningModule):
    """L = λ_IC L^IC + λ_DM L^DM, both through the same rendering.

    Args:
        model: arguments of `NerfDiff`, as plain data.
        losses: `lambda_ic` and `lambda_dm`, 0 for a part that is not trained: without L^DM the field alone is, without
            L^IC the CDM alone, on the renderings of a field that stays as it is. `ray_share`: L^IC is measured on so
            many of a target's rays, drawn anew at every step. `through_rendering`: the gradient of L^DM flows back
            through the rendering into the field (paper).
        optimizer: AdamW's `lr`, `weight_decay`, `betas`; `warmup_steps` of linear warm-up; `decay` is `none` or
            `cosine`, to zero at the end of training: at `max_steps`, or at `max_time` where that is sooner.
        validation_times: times t at which the denoising loss is measured on held-out views.
        channels_last: memory layout of the U-Nets.
        seed: of all noise; see `nerfdiff.utils.randomness`.
        kept_renderings: folder where a frozen field's renderings are kept, instead of being made at every step.
        renderer: `backend` and `kernel_precision` of the `Renderer`, which suit a machine and are not saved.

    Raises:
        ConfigError: losses that train nothing, or that ask for gradients which are not computed.
    """

    def __init__(
        self,
        model: Mapping,
        losses: Mapping,
        optimizer: Mapping,
        validation_times: list[float],
        channels_last: bool,
        seed: int,
        kept_renderings: str | None = None,
        renderer: Mapping = MappingProxyType({}),
    ):
        super().__init__()
        losses = WHOLE | losses
        _check_losses(losses, kept_renderings)
        self.save_hyperparameters(ignore=["kept_renderings", "renderer"])
        self.model = NerfDiff(**model | {"render": {**model["render"], **renderer}})
        self.frozen_field = losses["lambda_ic"] == 0
        self._kept_folder, self._kept = kept_renderings, None
        self.begun_from: str | None = None  # SHA-256 of `init`'s weights
        if self.frozen_field:
            self.model.encoder.requires_grad_(False)
            self.model.decoder.requires_grad_(False)
        if losses["lambda_dm"] == 0:
            self.model.denoiser.requires_grad_(False)
        self.image_size: list[int] | None = None  # of the training images, once one was seen
        self.trained_before: list[dict[str, Any]] = []  # what `init` was trained on
        if channels_last:
            self.model.to(memory_format=torch.channels_last)

    def training_step(self, batch: ViewBatch, batch_idx: int) -> Tensor:
        self.image_size = list(batch.targets.shape[-2:])
        losses = WHOLE | self.hparams.losses
        # encode the source views
        with torch.no_grad() if self.frozen_field else nullcontext():
            encoding = self.model.encode(batch)
        # render the targets: L^IC
        noise = self._noise(batch, losses)
        loss_ic, rendering = self._photometric(batch, encoding, noise, losses)
        loss = losses["lambda_ic"] * loss_ic
        values = {"loss_ic": loss_ic, "psnr": psnr_of_mse(loss_ic.detach())}
        # denoise the targets, conditioned on the renderings: L^DM
        if losses["lambda_dm"]:
            loss_dm = self._diffusion(batch, encoding, rendering, noise["eps"])
            loss = loss + losses["lambda_dm"] * loss_dm
            values["loss_dm"] = loss_dm
        values["loss"] = loss
        size = len(batch)
        self.log_dict({f"train/{name}": value.detach() for name, value in values.items()}, batch_size=size)
        self.log("psnr", values["psnr"].detach(), prog_bar=True, logger=False, batch_size=size)
        return loss

    def validation_step(self, batch: ViewBatch, batch_idx: int) -> None:
        encoding = self.model.encode(batch)
        rendering = self.model.render(encoding, batch.target_cameras)
        rendered = rendering.images
        truth = batch.targets.flatten(0, 1)
        even = truth.mean((-2, -1), keepdim=True).expand_as(truth)  # what a field that collapsed is no better than
        self.log_dict(
            {
                "val/psnr": psnr(rendered.flatten(0, 1), truth).mean(),
                "val/psnr_even": psnr(even, truth).mean(),
                "val/loss_ic": F.mse_loss(rendered, batch.targets),
            },
            batch_size=len(batch),
            sync_dist=True,
        )
        condition = self.model.condition(encoding, batch.target_cameras, rendered)
        targets = to_signed(truth)
        eps = torch.randn(targets.shape, generator=generator("cpu", self.hparams.seed, "validation", batch_idx))
        losses = [
            self._denoising_loss(condition, targets, eps.to(targets), targets.new_full((len(targets),), t))
            for t in self.hparams.validation_times
        ]
        self.log("val/loss_dm", torch.stack(losses).mean(), batch_size=len(batch), sync_dist=True)

    def configure_optimizers(self) -> dict:
        options = dict(self.hparams.optimizer)
        warmup, decay = options.pop("warmup_steps"), options.pop("decay")
        if decay not in ("none", "cosine"):
            raise ConfigError(f"optimizer.decay must be none or cosine, got {decay!r}")
        options["betas"] = tuple(options["betas"])
        trained = [parameter for parameter in self.model.parameters() if parameter.requires_grad]
        optimizer = torch.optim.AdamW(trained, **options, fused=self.device.type == "cuda")
        total, timer = self.trainer.max_steps, timer_of(self.trainer)

        def factor(step: int) -> float:
            rise = min(1.0, (step + 1) / max(1, warmup))
            done = max(step / total, 0.0 if timer is None else share_of_time(timer))
            fall = 0.5 * (1 + math.cos(math.pi * min(1.0, done))) if decay == "cosine" else 1.0
            return rise * fall

        scheduler = torch.optim.lr_scheduler.LambdaLR(optimizer, factor)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": scheduler, "interval": "step"}}

    def configure_gradient_clipping(
        self, optimizer: Optimizer, gradient_clip_val: float | None = None, gradient_clip_algorithm: str | None = None
    ) -> None:
        """Clip by norm. Lightning's own refuses fused optimizers under autocast, because of fp16's scaler."""
        if gradient_clip_val:
            parameters = [p for group in optimizer.param_groups for p in group["params"]]
            clip_grad_norm_(parameters, gradient_clip_val, foreach=True)

    def on_train_start(self) -> None:
        """Apply the optimizer settings of this run, where Lightning has just restored the old ones."""
        (scheduler,) = (config.scheduler for config in self.trainer.lr_scheduler_configs)
        options = self.hparams.optimizer
        scheduler.base_lrs = [options["lr"] for _ in scheduler.base_lrs]
        for group, factor in zip(scheduler.optimizer.param_groups, scheduler.lr_lambdas, strict=True):
            group["initial_lr"], group["lr"] = options["lr"], options["lr"] * factor(scheduler.last_epoch)
            group["weight_decay"], group["betas"] = options["weight_decay"], tuple(options["betas"])

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Save settings that have to stay the same to resume, and those that describe the model."""
        checkpoint["accumulate_grad_batches"] = self.trainer.accumulate_grad_batches
        checkpoint["image_size"] = self.image_size
        checkpoint["trained_on"] = self.trained_on()
        checkpoint["begun_from"] = self.begun_from

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        self.trained_before = list(checkpoint.get("trained_on", [{}])[:-1])
        self.begun_from = checkpoint.get("begun_from")

    @property
    def kept(self) -> KeptRenderings | None:
        """Kept renderings of the frozen field, in a folder named by the weights that render them."""
        if self._kept is None and self._kept_folder is not None:
            weights = hashlib.sha256()
            for part in (self.model.encoder, self.model.decoder):
                for value in part.state_dict().values():
                    weights.update(value.cpu().contiguous().numpy().tobytes())
            self._kept = KeptRenderings(Path(self._kept_folder) / weights.hexdigest()[:12])
        return self._kept

    def trained_on(self) -> list[dict[str, Any]]:
        """Describe the training data of the weights: one entry for each training that led here, this one last."""
        data, losses = self.trainer.datamodule, self.hparams.losses
        part = "field" if losses["lambda_dm"] == 0 else "CDM" if losses["lambda_ic"] == 0 else "field and the CDM"
        seen = {
            "part": part,
            "images": self.trainer.global_step * data.batch_size * data.target_views,
            "dataset": data.name,
            "scenes": data.trained_scenes,
            "about": data.about,
            "git_sha": git_state(Path(__file__).parent)["git_sha"],
        }
        return [*self.trained_before, seen]

    def _photometric(
        self, batch: ViewBatch, encoding: Encoding, noise: dict[str, Tensor], losses: Mapping
    ) -> tuple[Tensor, Float[Tensor, "batch targets 3 height width"] | None]:
        """Compute L^IC (paper, eq. "pixelnerf"), and the renderings that condition the CDM (None: not trained)."""
        if self.frozen_field:
            with torch.no_grad():
                rendered = self._rendered(batch, encoding)
            return F.mse_loss(rendered, batch.targets), rendered
        whole = losses["ray_share"] == 1
        if whole:
            rendered = self.model.render(encoding, batch.target_cameras, noise["jitter"]).images
            loss_ic = F.mse_loss(rendered, batch.targets)
        else:
            loss_ic = self._on_some_rays(batch, encoding, noise["rays"], noise["jitter"])
        if not losses["lambda_dm"]:
            return loss_ic, None
        if whole:
            return loss_ic, rendered if losses["through_rendering"] else rendered.detach()
        with torch.no_grad():
            return loss_ic, self._rendered(batch, encoding)

    def _on_some_rays(self, batch: ViewBatch, encoding: Encoding, rays: Tensor, jitter: Tensor) -> Tensor:
        """Compute L^IC on rays [batch, n], numbered over all pixels of all targets of a draw."""
        bounds = encoding.features
        every = batch.target_cameras.rays(bounds.near[:, None], bounds.far[:, None])
        shape = every.directions.shape[:-1]
        some = Rays(
            *(
                torch.stack([of_one.flatten(0, 2)[index] for of_one, index in zip(part, rays, strict=True)])
                for part in (
                    every.origins.expand(*shape, 3),
                    every.directions,
                    every.near.expand(shape),
                    every.far.expand(shape),
                )
            )
        )
        rgb = self.model.renderer.render(self.model.field(encoding), some, jitter).rgb
        colours = batch.targets.movedim(2, -1).flatten(1, 3)
        return F.mse_loss(rgb, torch.stack([one[index] for one, index in zip(colours, rays, strict=True)]))

    def _rendered(self, batch: ViewBatch, encoding: Encoding) -> Float[Tensor, "batch targets 3 height width"]:
        """Render whole targets without gradients or jitter; a frozen field's renderings are kept."""
        if self.kept is None:
            return self.model.render(encoding, batch.target_cameras).images
        images = []
        for draw, (scene, source, targets) in enumerate(
            zip(batch.scene_ids, batch.source_views, batch.target_views, strict=True)
        ):
            one = slice(draw, draw + 1)
            triplane = encoding.triplane
            alone = Triplane(triplane.planes[one], triplane.cameras[one], triplane.near[one], triplane.far[one])
            own = replace(encoding, source=encoding.source[one], features=alone)

            def render(views: list[int], own: Encoding = own, one: slice = one) -> Tensor:
                return self.model.render(own, batch.target_cameras[one, views]).images[0]

            names = [f"{scene}/{source}/{target}" for target in targets]
            images.append(self.kept.get(names, tuple(batch.targets.shape[-2:]), render))
        return torch.stack(images).to(batch.targets)

    def _diffusion(self, batch: ViewBatch, encoding: Encoding, rendered: Tensor, eps: Tensor) -> Tensor:
        """Compute L^DM (paper, eq. "ddpm") on v."""
        condition = self.model.condition(encoding, batch.target_cameras, rendered)
        targets = to_signed(batch.targets.flatten(0, 1))
        views = batch.target_cameras.shape[1]
        each = (batch.draws[:, None] * views + torch.arange(views)).flatten()
        times = spread_times(each, self.hparams.seed).to(targets.device, non_blocking=True)
        return self._denoising_loss(condition, targets, eps.flatten(0, 1), times)

    def _denoising_loss(
        self,
        condition: Condition,
        x0: Float[Tensor, "batch 3 height width"],
        eps: Float[Tensor, "batch 3 height width"],
        t: Float[Tensor, "batch"],
    ) -> Tensor:
        alpha, sigma = (expand(c, x0) for c in alpha_sigma(t))
        predicted = self.model.denoiser.velocity(add_noise(x0, eps, alpha, sigma), t, condition)
        return F.mse_loss(predicted, v_from_x0_eps(x0, eps, alpha, sigma))

    def _noise(self, batch: ViewBatch, losses: Mapping) -> dict[str, Tensor]:
        """Draw ε, the chosen rays and the ray jitter of every training item, each a function of its draw alone."""
        targets = batch.targets
        samples = self.model.renderer.samples_per_ray
        rays = targets.shape[1] * targets.shape[-2] * targets.shape[-1]
        some = max(1, round(losses["ray_share"] * rays))
        generators = [generator(self.device, self.hparams.seed, "noise", int(d)) for d in batch.draws.tolist()]
        noise = {}
        if not self.frozen_field:
            noise["jitter"] = torch.stack([torch.rand(some, samples, generator=g, device=g.device) for g in generators])
        if losses["lambda_dm"]:
            noise["eps"] = torch.stack(
                [torch.randn(targets.shape[1:], generator=g, device=g.device) for g in generators]
            )
        if losses["ray_share"] < 1:
            noise["rays"] = torch.stack([torch.randperm(rays, generator=g, device=g.device)[:some] for g in generators])
        return noise


def _check_losses(losses: Mapping, kept_renderings: str | None) -> None:
    ic, dm, share = losses["lambda_ic"], losses["lambda_dm"], losses["ray_share"]
    if ic < 0 or dm < 0 or ic == dm == 0:
        raise ConfigError(f"losses.lambda_ic={ic}, lambda_dm={dm}: neither may be negative, nor both be 0")
    if not 0 < share <= 1:
        raise ConfigError(f"losses.ray_share={share}: expected a share above 0, at most 1")
    if losses["through_rendering"] and ic and dm and share < 1:
        raise ConfigError(
            f"losses.ray_share={share} renders some of the rays with gradients, and the CDM's gradient needs them all: "
            "set losses.through_rendering=false, or losses.ray_share=1"
        )
    if kept_renderings and ic:
        raise ConfigError("kept_renderings are of a field that does not change: set losses.lambda_ic=0, or it to null")
