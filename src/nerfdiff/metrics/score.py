"""Score saved predictions against the truth. Needs no model, and can be run again at any time."""

import json
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from jaxtyping import UInt8
from rich.markup import escape
from rich.progress import track
from torch import Tensor

from nerfdiff.data.scene import Scene, SceneReader
from nerfdiff.fit.saved_field import FIELD
from nerfdiff.metrics import depth as depth_metrics
from nerfdiff.metrics import image as image_metrics
from nerfdiff.metrics.consistency import Consistency
from nerfdiff.metrics.perceptual import LPIPS, LPIPS_NET, LPIPS_VGG, STLPIPS
from nerfdiff.metrics.predictions import SCENE, Prediction, read_plan, read_prediction
from nerfdiff.metrics.sets import SETS, FrechetDistance, InceptionFeatures, inception_weights, sets, write_statistics
from nerfdiff.metrics.summary import FACTS, SPENT, SceneScores, Value, summarise, write_csv
from nerfdiff.metrics.table import METRICS, PACKAGE, named
from nerfdiff.metrics.table import own as own_metrics
from nerfdiff.metrics.whole_scene import Geometry, WholeScene
from nerfdiff.utils.errors import DataError
from nerfdiff.utils.files import encode, write_text
from nerfdiff.utils.shard import Shard

Truth = Callable[[str, Sequence[str]], Scene]


def truth_from(reader: SceneReader) -> Truth:
    """Look up scenes of `reader` by their id and views by their names.

    Raises (when called):
        DataError: the reader has no such scene or view.
    """
    index_of = {reader.scene_id(i): i for i in range(len(reader))}

    def truth(scene_id: str, views: Sequence[str]) -> Scene:
        if scene_id not in index_of:
            raise DataError(f"predicted scene {scene_id!r} is not in the dataset {reader.identity}")
        names = reader.view_names(index_of[scene_id])
        position = {name: i for i, name in enumerate(names)}
        if missing := [view for view in views if view not in position]:
            raise DataError(f"scene {scene_id}: the dataset {reader.identity} has no view {missing[0]!r}")
        return reader.load(index_of[scene_id], [position[view] for view in views], truth=True)

    return truth


class Scorer:
    """The metrics of one evaluation, by one protocol.

    Weight files are looked for at once, so that what will be missing is known before any model runs.

    Args:
        psnr_floor: least MSE that PSNR counts; 1e-6 caps it at 60 dB.
        ssim_gaussian: also measure SSIM with an 11×11 Gaussian window.
        lpips: measure LPIPS with VGG16, if its weights are there.
        lpips_weights: path of torchvision's VGG16 weights; None looks in torch hub's cache.
        st_lpips: measure shift-tolerant LPIPS, and the Fréchet distance on its features.
        fid: measure FID, if its weights and torch-fidelity are there.
        fid_weights: path of torch-fidelity's Inception weights; None looks in torch hub's cache.
        opacity_threshold: above it a pixel counts as hit.
        min_size: images smaller than this many pixels are enlarged for the two LPIPS networks.
        batch: images per pass through a network.
        geometry: how floaters and depth extent are measured.
        consistency: how the agreement of views is measured.
        own: metrics of images of your own, see `table.own`.

    Raises:
        DataError: a weights file is damaged.
        ConfigError: `own` describes no metrics.
    """

    def __init__(
        self,
        psnr_floor: float,
        ssim_gaussian: bool,
        lpips: bool,
        lpips_weights: str | None,
        st_lpips: bool,
        fid: bool,
        fid_weights: str | None,
        opacity_threshold: float,
        min_size: int,
        batch: int,
        geometry: Geometry,
        consistency: Consistency,
        own: Mapping[str, Mapping[str, Any]],
    ):
        self.psnr_floor, self.ssim_gaussian, self.st_lpips = psnr_floor, ssim_gaussian, st_lpips
        self.opacity_threshold, self.min_size, self.batch = opacity_threshold, min_size, batch
        self.whole_scene = WholeScene(geometry, consistency, opacity_threshold)
        self.own = own_metrics(own)
        self.lpips_weights = LPIPS_VGG.find(lpips_weights) if lpips else None
        self.fid_weights = inception_weights(fid_weights) if fid else None

    def score(
        self,
        folder: str | Path,
        truth: Truth,
        out: str | Path,
        device: torch.device | str = "cpu",
        shard: Shard | None = None,
    ) -> dict[str, Value]:
        """Score the predictions of one strategy.

        Args:
            folder: `<predictions>/<strategy>`, written by `PredictionWriter`.
            truth: the true views of a scene, see `truth_from`.
            out: receives per_image.csv, per_scene.csv and summary.json; of a shard `SETS`, too.
            shard: that the scenes are, of a larger set.

        Returns:
            the summary: metrics (None where not measured), which variants they are and over how many images,
            under the names of `ResultRow`.

        Raises:
            DataError: scenes are not predicted yet, or a file is missing, damaged or of another size.
        """
        folder, out = Path(folder), Path(out)
        planned = read_plan(folder)["scenes"]
        if pending := [scene for scene in planned if not (folder / scene / SCENE).exists()]:
            raise DataError(
                f"{folder}: {len(pending)} of {len(planned)} scenes are not predicted yet, "
                f"first {pending[0]}; run the evaluation again to complete them"
            )
        session = _Session(self, torch.device(device))
        quiet = not sys.stderr.isatty()
        scenes = [
            session.scene(shard.index(number) if shard else number, folder, scene, truth)
            for number, scene in enumerate(track(planned, escape(f"scoring {folder.name}"), disable=quiet))
        ]
        summary = summarise(scenes) | sets(session.fid, session.fd_st_vgg)
        summary["ssim_impl"] = image_metrics.SSIM_IMPL
        summary["lpips_net"] = LPIPS_NET if self.lpips_weights else None
        described = {metric.name: {"value": summary[metric.name], **metric.description()} for metric in self.own}
        summary = {name: value for name, value in summary.items() if name not in METRICS or METRICS[name] in PACKAGE}
        summary["own_metrics"] = described or None
        rows = [row for scene in scenes for row in scene.image_rows()]
        write_csv(out / "per_image.csv", ("scene", "view", *named("image")), rows)
        per_scene = [scene.row() for scene in scenes]
        write_csv(out / "per_scene.csv", (*FACTS, *SPENT, *named("image", "scene")), per_scene)
        if shard is not None:
            write_statistics(out / SETS, fid=session.fid, fd_st_vgg=session.fd_st_vgg)
        write_text(out / "summary.json", json.dumps(encode(summary), indent=1, allow_nan=False) + "\n")
        return summary


class _Session:
    """Networks on a device, and the statistics of one pass over the scenes."""

    def __init__(self, scorer: Scorer, device: torch.device):
        self.scorer, self.device = scorer, device
        self.lpips = LPIPS(scorer.lpips_weights, device, scorer.min_size) if scorer.lpips_weights else None
        self.st_lpips = STLPIPS(device, scorer.min_size) if scorer.st_lpips else None
        self.inception = InceptionFeatures(scorer.fid_weights, device) if scorer.fid_weights else None
        self.fid, self.fd_st_vgg = FrechetDistance(), FrechetDistance()

    def scene(self, number: int, folder: Path, scene_id: str, truth: Truth) -> SceneScores:
        prediction = read_prediction(folder, scene_id)
        scene = truth(prediction.scene_id, prediction.views)
        if scene.views != prediction.views or scene.pixels.shape != prediction.pixels.shape:
            raise DataError(
                f"scene {prediction.scene_id}: predicted {len(prediction.views)} views of shape "
                f"{tuple(prediction.pixels.shape[1:])}, the dataset gives {len(scene.views)} of shape "
                f"{tuple(scene.pixels.shape[1:])}; score with the dataset settings of the evaluation"
            )
        values: dict[str, list[float | None]] = {}
        for pixels, true_pixels in zip(
            prediction.pixels.split(self.scorer.batch), scene.pixels.split(self.scorer.batch), strict=True
        ):
            for metric, measured in self._batch(pixels, true_pixels).items():
                values.setdefault(metric, []).extend(measured)
        blank = bool((scene.pixels == 255).all())
        values |= self._geometry(prediction, scene)
        whole = {}
        if prediction.source_views:  # whose camera's space all geometry is in
            whole = self.scorer.whole_scene.measure(
                number,
                prediction,
                scene,
                truth(scene_id, prediction.source_views[:1]),
                folder / scene_id / FIELD,
                self.device,
            )
        said = prediction.status, prediction.verdict, prediction.cost
        return SceneScores(scene_id, prediction.views, blank, values, whole, *said)

    def _batch(
        self, pixels: UInt8[Tensor, "n 3 h w"], true_pixels: UInt8[Tensor, "n 3 h w"]
    ) -> dict[str, list[float | None]]:
        pair = image_metrics.dequantise(pixels), image_metrics.dequantise(true_pixels)
        values = {
            "psnr": image_metrics.psnr(*pair, floor=self.scorer.psnr_floor).tolist(),
            "ssim": image_metrics.ssim(*pair).tolist(),
            "sharpness": image_metrics.sharpness(*pair),
        }
        if self.scorer.ssim_gaussian:
            values["ssim_gaussian"] = image_metrics.ssim_gaussian(*pair).tolist()
        if self.lpips:
            values["lpips"] = self.lpips(*pair).tolist()
        if self.st_lpips:
            distances, *features = self.st_lpips(*pair)
            values["st_lpips_vgg"] = distances.tolist()
            self.fd_st_vgg.update(*features)
        values |= {metric.name: metric.measure(*pair).tolist() for metric in self.scorer.own}
        if self.inception:
            self.fid.update(self.inception(pixels), self.inception(true_pixels))
        return values

    def _geometry(self, prediction: Prediction, scene: Scene) -> dict[str, list[float | None]]:
        values: dict[str, list[float | None]] = {}
        if prediction.depth is None or prediction.opacity is None:
            return values
        mask, threshold = scene.mask, self.scorer.opacity_threshold
        if scene.depth is not None:
            values["depth_abs_rel"], values["depth_rmse"] = depth_metrics.depth_errors(
                prediction.depth, prediction.opacity, scene.depth, threshold
            )
            mask = scene.depth > 0 if mask is None else mask
        if mask is not None:
            values["mask_iou"] = depth_metrics.mask_iou(prediction.opacity, mask, threshold)
        return values
