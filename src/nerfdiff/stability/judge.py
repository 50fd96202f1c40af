"""A verdict on a scene's predicted views by signs that need no truth: users have none."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool
from torch import Tensor

from nerfdiff.data.batch import ViewBatch
from nerfdiff.diffusion.schedule import add_noise, alpha_sigma
from nerfdiff.distill.strategy import PredictedViews
from nerfdiff.metrics.image import psnr
from nerfdiff.model import NerfDiff
from nerfdiff.stability.facts import FACTS
from nerfdiff.stability.familiar import Familiar, features
from nerfdiff.stress.photo import object_mask
from nerfdiff.utils.errors import ConfigError
from nerfdiff.utils.images import to_signed, to_unit
from nerfdiff.utils.randomness import generator
from nerfdiff.utils.spread import spread

SIGNS = {
    "input_psnr": "the field shows the input view as another picture ({:.1f} dB)",
    "input_iou": "its silhouette from the input view is another (IoU {:.2f})",
    "border": "the field reaches the border of a view (opacity {:.2f})",
    "coverage": "it fills another share of the views than the object does of the input (2^{:.1f})",
    "least_coverage": "a view is all but empty ({:.2f} of the middle one)",
    "haze": "it is fog, neither there nor not ({:.2f} of the object)",
    "flatness": "its colours vary as those of no object ({:.2f} of the input's)",
    "agreement": "it does not fit its targets ({:.1f} dB)",
    "moved": "distillation led far away from the single-image NeRF ({:.1f} dB)",
    "samples": "the diffusion model's samples disagree ({:.1f} dB)",
    "denoised": "the diffusion model sees other views than the field's ({:.1f} dB)",
    "unlike": "the input is unlike the training images ({:.2f} of their usual distance)",
    **{name: f"{words} ({{:.2f}} beyond their range)" for name, words in FACTS.items()},
}
"""What each sign says where it is out of its limits."""
LEAST, MOST = "least", "most"
ENDS = {
    **dict.fromkeys(
        ("input_psnr", "input_iou", "least_coverage", "agreement", "moved", "samples", "denoised"), (LEAST,)
    ),
    **dict.fromkeys(("border", "haze", "unlike", *FACTS), (MOST,)),
    **dict.fromkeys(("coverage", "flatness"), (LEAST, MOST)),
}
"""At which end each sign is bad."""
OK = "ok"


@dataclass(frozen=True)
class Judge:
    """Measures a scene's signs and says `ok`, or `suspect:` and why.

    Args:
        views: predicted views that signs are measured on, at most, spread evenly.
        time: diffusion time to which two noises are added, for the samples' disagreement.
        least, most: limits of signs, by name; a sign in neither is measured and never suspected.

    Raises:
        ConfigError: a limit of a sign that there is not.
    """

    views: int
    time: float
    least: Mapping[str, float]
    most: Mapping[str, float]

    def __post_init__(self):
        if unknown := (self.least.keys() | self.most.keys()) - SIGNS.keys():
            raise ConfigError(f"judge: {sorted(unknown)[0]} is no sign; choose {', '.join(SIGNS)}")

    @torch.no_grad()
    def signs(
        self, model: NerfDiff, scene: ViewBatch, predicted: PredictedViews, familiar: Familiar | None, seed: int
    ) -> dict[str, float]:
        """Measure the signs of one scene; facts of its input are those before it was sharpened.

        Args:
            predicted: views of `scene.target_cameras`.
            familiar: of the model's training images; None: not known.
        """
        mask = object_mask(scene.source[0])
        encoding = model.encode(scene)
        given = scene if scene.soft_pixels is None else replace(scene, source_pixels=scene.soft_pixels)
        found = {} if familiar is None else familiar.beyond(given)
        if familiar is not None and (of_input := features(encoding)) is not None:
            found["unlike"] = float(familiar.distance(of_input)[0])
        chosen = spread(len(predicted.images), self.views)
        images, cameras = predicted.images[chosen].clamp(0, 1), scene.target_cameras[:, chosen]
        first = model.render(encoding, cameras)
        if predicted.trace:
            found["moved"] = float(psnr(images, first.images[0].clamp(0, 1)).mean())
        if predicted.trace and predicted.trace[-1].agreement is not None:
            found["agreement"] = predicted.trace[-1].agreement
        if predicted.opacity is not None:
            found |= _of_opacity(predicted.opacity[chosen], images, scene.source[0], mask)
        found |= self._of_samples(model, encoding, cameras, first.images, images, (seed, "judge", *scene.scene_ids))
        if predicted.field is not None:
            own = predicted.field.field.to(scene.source.device)
            shown = own.render(predicted.field.renderer, scene.source_cameras[:, None])
        else:
            shown = model.render(encoding, scene.source_cameras[:, None])
        found["input_psnr"] = float(psnr(shown.images[0].clamp(0, 1), scene.source)[0])
        found["input_iou"] = _iou(shown.opacity[0, 0] > 0.5, mask)
        return found

    def verdict(self, signs: Mapping[str, float], status: str = OK) -> str:
        """Return `ok`, or `suspect:` with what is out of its limits; a sign that is not finite is.

        Args:
            status: of the prediction: a scene that fell back is suspect.
        """
        why = [f"it fell back ({status})"] if status != OK else []
        for name, value in signs.items():
            low, high = self.least.get(name, -math.inf), self.most.get(name, math.inf)
            judged = name in self.least or name in self.most
            if judged and not low <= value <= high:
                why.append(SIGNS[name].format(value))
        return f"suspect: {'; '.join(why)}" if why else OK

    def _of_samples(self, model, encoding, cameras, rendered, images, seed) -> dict[str, float]:
        """Noise the views twice and denoise each: samples of a scene that the model knows agree."""
        condition = model.condition(model.with_keys_values(encoding), cameras, rendered)
        time = torch.full((len(images),), self.time, device=images.device)
        made = []
        for draw in range(2):
            noise = torch.randn(images.shape, generator=generator("cpu", *seed, draw)).to(images)
            z = add_noise(to_signed(images), noise, *alpha_sigma(torch.tensor(self.time, device=images.device)))
            made.append(to_unit(model.denoiser(z, time, condition).clamp(-1, 1)))
        middle = (made[0] + made[1]) / 2
        return {"samples": float(psnr(*made).mean()), "denoised": float(psnr(middle, images).mean())}


def _of_opacity(opacity: Tensor, images: Tensor, source: Tensor, mask: Bool[Tensor, "h w"]) -> dict[str, float]:
    edge = torch.ones_like(opacity[0], dtype=torch.bool)
    edge[1:-1, 1:-1] = False
    shares = opacity.mean((1, 2))
    solid = opacity > 0.5
    touched = (opacity > 0.05).sum().clamp_min(1)
    own = source[:, mask].std() if mask.sum() > 1 else torch.tensor(1.0)
    pairs = zip(images, solid, strict=True)
    colours = torch.stack([image[:, where].std() if where.sum() > 1 else image.new_zeros(()) for image, where in pairs])
    return {
        "border": float(opacity[:, edge].mean(1).max()),
        "coverage": float(torch.log2(shares.mean().clamp_min(1e-6) / mask.float().mean().clamp_min(1e-6))),
        "least_coverage": float(shares.min() / shares.median().clamp_min(1e-6)),
        "haze": float(((opacity > 0.1) & (opacity < 0.9)).sum() / touched),
        "flatness": float(colours.mean() / own.clamp_min(1e-6)),
    }


def _iou(first: Bool[Tensor, "h w"], second: Bool[Tensor, "h w"]) -> float:
    union = int((first | second).sum())
    return int((first & second).sum()) / union if union else 1.0
