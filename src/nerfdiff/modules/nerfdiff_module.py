"""Joint training of the single-image NeRF and the CDM (paper, "Training Phase")."""

import math
from collections.abc import Mapping
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Float
from lightning import LightningModule
from torch import Tensor

from nerfdiff.data.batch import ViewBatch
from nerfdiff.diffusion.schedule import add_noise, alpha_sigma, expand, v_from_x0_eps
from nerfdiff.errors import ConfigError
from nerfdiff.metrics.image import psnr, psnr_of_mse
from nerfdiff.model import NerfDiff
from nerfdiff.randomness import generator, spread_times


class NerfDiffModule(LightningModule):
    """L = λ_IC L^IC + λ_DM L^DM, both through the same rendering.

    Args:
        model: arguments of `NerfDiff`, as plain data.
        losses: `lambda_ic` and `lambda_dm`.
        optimizer: AdamW's `lr`, `weight_decay`, `betas`; `warmup_steps` of linear warm-up; `decay` is `none` or
            `cosine`, to zero at the end of training.
        validation_times: times t at which the denoising loss is measured on held-out views.
        channels_last: memory layout of the U-Nets.
        seed: of all noise; see `nerfdiff.randomness`.
    """

    def __init__(
        self,
        model: Mapping,
        losses: Mapping,
        optimizer: Mapping,
        validation_times: list[float],
        channels_last: bool,
        seed: int,
    ):
        super().__init__()
        self.save_hyperparameters()
        self.model = NerfDiff(**model)
        self.image_size: list[int] | None = None  # of the training images, once one was seen
        if channels_last:
            self.model.to(memory_format=torch.channels_last)

    def training_step(self, batch: ViewBatch, batch_idx: int) -> Tensor:
        self.image_size = list(batch.targets.shape[-2:])
        noise = self._noise(batch)
        times = spread_times(batch.draws, self.hparams.seed)
        loss_ic, loss_dm = self._losses(batch, times, **noise)
        loss = self.hparams.losses["lambda_ic"] * loss_ic + self.hparams.losses["lambda_dm"] * loss_dm
        values = {"loss": loss, "loss_ic": loss_ic, "loss_dm": loss_dm, "psnr": psnr_of_mse(loss_ic.detach())}
        size = len(batch)
        self.log_dict({f"train/{name}": value.detach() for name, value in values.items()}, batch_size=size)
        self.log("psnr", values["psnr"].detach(), prog_bar=True, logger=False, batch_size=size)
        return loss

    def validation_step(self, batch: ViewBatch, batch_idx: int) -> None:
        encoding = self.model.encode(batch.source, batch.source_cameras, batch.near, batch.far)
        rendering = self.model.render(encoding, batch.target_cameras)
        rendered = rendering.rgb.movedim(-1, 2)
        self.log_dict(
            {
                "val/psnr": psnr(rendered.flatten(0, 1), batch.targets.flatten(0, 1)).mean(),
                "val/loss_ic": F.mse_loss(rendered, batch.targets),
            },
            batch_size=len(batch),
            sync_dist=True,
        )
        condition = self.model.condition(encoding, batch.target_cameras, rendering)
        targets = 2 * batch.targets.flatten(0, 1) - 1
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
        optimizer = torch.optim.AdamW(self.model.parameters(), **options)
        total = self.trainer.max_steps

        def factor(step: int) -> float:
            rise = min(1.0, (step + 1) / max(1, warmup))
            fall = 0.5 * (1 + math.cos(math.pi * min(1.0, step / total))) if decay == "cosine" else 1.0
            return rise * fall

        scheduler = torch.optim.lr_scheduler.LambdaLR(optimizer, factor)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": scheduler, "interval": "step"}}

    def on_train_start(self) -> None:
        """A resumed run follows the settings it is given, where Lightning has just restored the old ones."""
        (scheduler,) = (config.scheduler for config in self.trainer.lr_scheduler_configs)
        options = self.hparams.optimizer
        scheduler.base_lrs = [options["lr"] for _ in scheduler.base_lrs]
        for group, factor in zip(scheduler.optimizer.param_groups, scheduler.lr_lambdas, strict=True):
            group["initial_lr"], group["lr"] = options["lr"], options["lr"] * factor(scheduler.last_epoch)
            group["weight_decay"], group["betas"] = options["weight_decay"], tuple(options["betas"])

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """What a person has to keep the same to resume, or to use the model well."""
        checkpoint["accumulate_grad_batches"] = self.trainer.accumulate_grad_batches
        checkpoint["image_size"] = self.image_size

    def _losses(self, batch: ViewBatch, times: Tensor, jitter: Tensor, eps: Tensor) -> tuple[Tensor, Tensor]:
        """(L^IC, L^DM) of the paper's eqs. "pixelnerf" and "ddpm", the latter on v."""
        encoding = self.model.encode(batch.source, batch.source_cameras, batch.near, batch.far)
        rendering = self.model.render(encoding, batch.target_cameras, jitter)
        loss_ic = F.mse_loss(rendering.rgb.movedim(-1, 2), batch.targets)
        condition = self.model.condition(encoding, batch.target_cameras, rendering)
        targets = 2 * batch.targets.flatten(0, 1) - 1
        times = times.repeat_interleave(batch.target_cameras.shape[1])
        return loss_ic, self._denoising_loss(condition, targets, eps.flatten(0, 1), times)

    def _denoising_loss(
        self, condition, x0: Float[Tensor, "batch 3 height width"], eps: Tensor, t: Float[Tensor, "batch"]
    ) -> Tensor:
        alpha, sigma = (expand(c, x0) for c in alpha_sigma(t))
        predicted = self.model.denoiser.velocity(add_noise(x0, eps, alpha, sigma), t, condition)
        return F.mse_loss(predicted, v_from_x0_eps(x0, eps, alpha, sigma))

    def _noise(self, batch: ViewBatch) -> dict[str, Tensor]:
        """ε and the ray jitter of every training item, each a function of its draw alone."""
        targets = batch.targets
        samples = self.model.renderer.samples_per_ray
        rays = targets.shape[1] * targets.shape[-2] * targets.shape[-1]
        generators = [generator(self.device, self.hparams.seed, "noise", int(d)) for d in batch.draws.tolist()]
        return {
            "jitter": torch.stack([torch.rand(rays, samples, generator=g, device=g.device) for g in generators]),
            "eps": torch.stack([torch.randn(targets.shape[1:], generator=g, device=g.device) for g in generators]),
        }
