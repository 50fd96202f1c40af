"""A scene of which nothing is to be seen is read, batched and measured as any other."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

import abo_fixtures
import clevr_fixtures
import posed_fixtures
from nerfdiff.data.batch import Sample, ViewBatch
from nerfdiff.data.readers.abo_materials import ABOMaterials
from nerfdiff.data.readers.abo_renders import ABORenders
from nerfdiff.data.readers.clevr3d import Clevr3DReader
from nerfdiff.data.readers.posed_images import PosedImagesReader
from nerfdiff.data.scene import SceneReader
from nerfdiff.metrics.depth import depth_errors, mask_iou
from nerfdiff.metrics.image import psnr, ssim, ssim_gaussian


def repaint(folder: Path, pattern: str, mode: str, value) -> None:
    """Every pixel of these images gets the value."""
    files = list(folder.rglob(pattern))
    assert files
    for file in files:
        with Image.open(file) as image:
            size = image.size
        Image.new(mode, size, value).save(file)


def renders(root: Path, index: Path) -> ABORenders:
    abo_fixtures.write_renders(root, items=1, size=(32, 32))
    repaint(root, "*.png", "RGBA", (255, 255, 255, 0))
    (root / "B000/depth").mkdir()
    for file in (root / "B000").glob("*.png"):
        np.savez(root / f"B000/depth/{file.stem}.npz", depth=np.zeros((32, 32), np.float32))
    return ABORenders(root, "train", 3.2, 6.7, abo_fixtures.DISTANCE, "auto", 0, {"train": 1}, index)


def materials(root: Path, index: Path) -> ABOMaterials:
    abo_fixtures.write_materials(root, train=1, test=0, views=4, size=32, environments=("0",))
    repaint(root, "render_*.jpg", "RGB", (255, 255, 255))
    repaint(root, "segmentation_*.jpg", "L", 0)
    for file in root.rglob("*.exr"):
        abo_fixtures.write_exr(file, np.full((32, 32), 65504.0))
    settings = {"environment": "all", "depth_kind": "z", "missing_items": "error", "val_fraction": 0.0, "split_seed": 0}
    return ABOMaterials(root, "train", 2.45, 7.45, abo_fixtures.DISTANCE, "auto", index_dir=index, **settings)


def clevr(root: Path, _: Path) -> Clevr3DReader:
    clevr_fixtures.write_clevr3d(root, scenes=1, height=30, width=40)
    repaint(root, "img_*.png", "RGBA", (255, 255, 255, 255))
    repaint(root, "masks_*.png", "L", 0)
    for file in (root / "depths").iterdir():
        Image.fromarray(np.full((30, 40), 65535, np.uint16)).save(file)
    return Clevr3DReader(root, "train", {"train": [0, 1]}, **clevr_fixtures.SETTINGS)


def nerfstudio(root: Path, _: Path, **lens) -> PosedImagesReader:
    posed_fixtures.write_nerfstudio(root, views=4, **lens)
    repaint(root, "images/*.png", "RGB", (255, 255, 255))
    repaint(root, "masks/*.png", "L", 0)
    return PosedImagesReader(root, "train", max_mask_border=None, **posed_fixtures.SETTINGS)


def blender(root: Path, _: Path) -> PosedImagesReader:
    posed_fixtures.write_blender(root)
    repaint(root, "*.png", "RGBA", (0, 0, 0, 0))
    return PosedImagesReader(root, "train", **posed_fixtures.SETTINGS)


@dataclass(frozen=True)
class Case:
    reader: Callable[[Path, Path], SceneReader]
    has_depth: bool


CASES = {
    "abo_renders": Case(renders, True),
    "abo_materials": Case(materials, True),
    "clevr3d": Case(clevr, True),
    "nerfstudio": Case(nerfstudio, False),
    "nerfstudio_distorted": Case(lambda root, index: nerfstudio(root, index, k1=-0.2, p1=0.01), False),
    "blender": Case(blender, False),
}


@pytest.mark.parametrize("name", CASES)
def test_white_scenes(tmp_path, name):
    case = CASES[name]
    scene = case.reader(tmp_path / "data", tmp_path / "index").load(0, truth=True)
    assert (scene.pixels == 255).all() and not scene.mask.any()
    assert scene.depth is None if not case.has_depth else not scene.depth.any()
    assert scene.cameras.c2w.isfinite().all() and 0 < scene.near < scene.far
    batch = ViewBatch.collate([Sample(scene, 0, [1, 2], 0), Sample(scene, 2, [0, 2], 1)])
    truth, mask = batch.targets.flatten(0, 1), batch.target_mask.flatten(0, 1)
    white, grey = torch.ones_like(truth), torch.full_like(truth, 0.5)
    assert psnr(white, truth).tolist() == pytest.approx([60.0] * 4)
    assert psnr(grey, truth).tolist() == pytest.approx([6.0206] * 4, abs=1e-3)
    for similarity in (ssim, ssim_gaussian):
        assert similarity(white, truth).tolist() == pytest.approx([1.0] * 4)
        assert similarity(grey, truth).isfinite().all()
    empty = torch.zeros(mask.shape)
    assert mask_iou(empty, mask, 0.5) == [1.0] * 4 and mask_iou(empty + 1, mask, 0.5) == [0.0] * 4
    if case.has_depth:
        depth = batch.target_depth.flatten(0, 1)
        assert depth_errors(empty + 5, empty + 1, depth, 0.5) == ([None] * 4, [None] * 4)
