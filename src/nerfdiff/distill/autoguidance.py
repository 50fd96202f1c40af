"""Autoguidance (Karras et al. 2024, arXiv 2406.02507): denoised images, pushed away from what an earlier snapshot of
the same CDM makes of them."""

import copy
import logging
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import torch
from jaxtyping import Float
from safetensors import SafetensorError, safe_open
from torch import Tensor

from nerfdiff.checkpoint import load_model
from nerfdiff.diffusion.denoiser import Denoiser
from nerfdiff.inputs import WEIGHTS
from nerfdiff.model import NerfDiff
from nerfdiff.utils.errors import CheckpointError, ConfigError

log = logging.getLogger(__name__)

PART = "denoiser."
ADVICE = "Name an earlier snapshot of the model's own training"


@dataclass(frozen=True)
class Autoguidance:
    """x̃0 = x0_weak + scale (x0 − x0_weak): the errors that both make grow with how weak a model is.

    The snapshot's CDM sees what the model's own sees: the same renderings, and the same encoder's features.

    Args:
        ckpt: an earlier snapshot of the model (`<run>/snapshots/step_….safetensors`), or an earlier export or
            checkpoint, as `ckpt=` takes them; None: no autoguidance. Each denoiser call is then two.
        scale: 1 changes nothing; the paper has 1.5 to 2.5.

    Raises:
        ConfigError: `scale` is less than 1.
    """

    ckpt: str | None = None
    scale: float = 1.5
    _known: list = field(default_factory=list, init=False, repr=False, compare=False)

    def __post_init__(self):
        if not self.scale >= 1:
            raise ConfigError(f"autoguidance.scale={self.scale} must be at least 1, which changes nothing")

    @property
    def on(self) -> bool:
        """True if there is a snapshot, and two denoiser calls in the place of one."""
        return self.ckpt is not None

    def __call__(
        self, x0: Float[Tensor, "views 3 height width"], weak: Float[Tensor, "views 3 height width"]
    ) -> Float[Tensor, "views 3 height width"]:
        """Guide denoised images by those of the snapshot; exactly `x0` for a scale of 1."""
        return x0 + (self.scale - 1) * (x0 - weak)

    def denoiser(self, model: NerfDiff) -> Denoiser:
        """Return the snapshot's CDM, frozen, where the model's is; read once.

        Raises:
            CheckpointError: there is no such file, it cannot be read, or it is of a CDM of other sizes or conditioning.
        """
        if not self._known or self._known[0] is not model:
            self._known[:] = model, self._read(model)
        return self._known[1]

    def _read(self, model: NerfDiff) -> Denoiser:
        path = Path(self.ckpt)
        is_snapshot = path.suffix == ".safetensors" and path.name != WEIGHTS
        state = _snapshot(path) if is_snapshot else self._exported(model)
        expected = {name: value.shape for name, value in model.denoiser.named_parameters()}
        found = {name: value.shape for name, value in state.items()}
        if wrong := sorted(name for name in expected | found if expected.get(name) != found.get(name)):
            there, here = (found.get(wrong[0]), expected.get(wrong[0]))
            raise CheckpointError(
                f"autoguidance.ckpt={self.ckpt} is of a CDM of other sizes or conditioning: {len(wrong)} weights "
                f"differ, as {wrong[0]}, {there} there and {here} here. {ADVICE}"
            )
        denoiser = copy.deepcopy(model.denoiser)
        # fresh tensors in the place of the copied ones: types and devices stay the model's
        for name, value in denoiser.named_parameters():
            value.data = state[name].to(value)
        return denoiser.requires_grad_(False).eval()

    def _exported(self, model: NerfDiff) -> Mapping[str, Tensor]:
        """Return the CDM's weights of an export or a checkpoint."""
        weak = load_model(self.ckpt, "ema").model
        own, theirs = (
            (m.denoiser.image, m.denoiser.ray_maps, m.denoiser.cross_attention, m.denoiser.residual_std)
            for m in (model, weak)
        )
        if own != theirs:
            raise CheckpointError(
                f"autoguidance.ckpt={self.ckpt} is of a CDM of another conditioning: {theirs} there and {own} here "
                f"(image, ray_maps, cross_attention, residual_std). {ADVICE}"
            )
        encoders = zip(model.encoder.parameters(), weak.encoder.parameters(), strict=False)
        if not all(torch.equal(one.cpu(), other) for one, other in encoders if one.shape == other.shape):
            log.warning(
                "autoguidance.ckpt=%s has another encoder: its CDM will see features it was not trained with", self.ckpt
            )
        return dict(weak.denoiser.named_parameters())


def _snapshot(path: Path) -> Mapping[str, Tensor]:
    """Return the CDM's weights of a snapshot (`nerfdiff.averages`), which may hold the rest of the model too."""
    try:
        with safe_open(path, "pt") as file:
            names = [name for name in file.keys() if name.startswith(PART)]  # noqa: SIM118 (no dictionary)
            return {name.removeprefix(PART): file.get_tensor(name) for name in names}
    except (SafetensorError, OSError) as error:
        raise CheckpointError(
            f"autoguidance.ckpt={path} is not a readable snapshot ({error}): name a file of a run's snapshots/, or a "
            "folder that was exported"
        ) from error
