"""Does input-view reconstruction collapse to a plane facing the camera (paper, appendix), and does noise prevent it?

    python benchmarks/clevr_collapse.py runs/clevr_0.0 runs/clevr_0.3 --data data=clevr3d data.root=data/clevr3d

For runs that differ in `data.source_target_noise`: how well the input view and the two held-out views are rendered,
and how the depth of the input view compares with the truth. A plane facing the camera renders the input well, has
hardly any spread of depth, and nothing to do with the true depth. Prints a table and writes a contact sheet.
"""

import argparse
from pathlib import Path

import torch
from hydra.utils import instantiate
from rich.console import Console
from rich.progress import track
from rich.table import Table

from nerfdiff.checkpoint import load_model
from nerfdiff.cli import CONF, load_config
from nerfdiff.data.batch import Sample, ViewBatch
from nerfdiff.data.scene import SceneReader
from nerfdiff.metrics.depth import z_depth
from nerfdiff.metrics.image import psnr
from nerfdiff.model import NerfDiff
from nerfdiff.results.pictures import colour_depth, contact_sheet


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path)
    parser.add_argument("--data", nargs="+", required=True, help="overrides of the evaluation config")
    parser.add_argument("--scenes", type=int, default=50)
    parser.add_argument("--shown", type=int, default=5, help="scenes in the picture")
    parser.add_argument("--out", type=Path, default=Path("clevr_collapse.png"))
    arguments = parser.parse_args()
    data = instantiate(load_config("evaluate", ["ckpt=none", *arguments.data]).data)
    reader = data.reader("test")
    batches = [one_scene(reader, index, data.source_view) for index in range(min(arguments.scenes, len(reader)))]
    table = Table(title=f"{len(batches)} held-out scenes, medians")
    for column in ("run", "input PSNR", "held-out PSNR", "depth spread / truth", "depth correlation", "depth abs rel"):
        table.add_column(column, justify="left" if column == "run" else "right")
    columns: dict[str, list[torch.Tensor]] = {"input": [], "true depth": [], "held-out": []}
    for batch in batches[: arguments.shown]:
        near, far = float(batch.near), float(batch.far)
        columns["input"].append(batch.source)
        columns["true depth"].append(colour_depth(batch.target_depth[:, 0], near, far))
        columns["held-out"].append(batch.targets[:, 1])
    for run in arguments.runs:
        model = load_model(run, "ema", CONF.parent / "assets").model
        pictures = {f"{run.name}: {what}": [] for what in ("input", "depth", "held-out")}
        values = []
        for number, batch in enumerate(track(batches, run.name)):
            images, depth, row = measured(model, batch)
            values.append(row)
            if number < arguments.shown:
                shown = images[:1], colour_depth(depth, float(batch.near), float(batch.far)), images[1:2]
                for column, image in zip(pictures.values(), shown, strict=True):
                    column.append(image)
        columns |= pictures
        medians = torch.tensor(values, dtype=torch.float64).median(0).values.tolist()
        table.add_row(run.name, *(f"{value:.3f}" if k > 1 else f"{value:.2f}" for k, value in enumerate(medians)))
    Console().print(table)
    print(contact_sheet(arguments.out, {name: torch.cat(images) for name, images in columns.items()}))


def one_scene(reader: SceneReader, index: int, source: int) -> ViewBatch:
    """The input view as its own target, and after it the others."""
    scene = reader.load(index, truth=True)
    others = [view for view in range(len(scene.views)) if view != source]
    return ViewBatch.collate([Sample(scene, source, [source, *others], index)])


@torch.no_grad()
def measured(model: NerfDiff, batch: ViewBatch) -> tuple[torch.Tensor, torch.Tensor, list[float]]:
    """Renders [views, 3, h, w], the input view's z-depth [1, h, w], and the row of the table."""
    encoding = model.encode(batch)
    rendering = model.render(encoding, batch.target_cameras)
    images = rendering.images[0]
    quality = psnr(images, batch.targets[0])
    depth, truth = z_depth(rendering.depth, batch.target_cameras)[0, 0], batch.target_depth[0, 0]
    hit = (truth > 0) & (truth < float(batch.far))
    d, t = depth[hit].double(), truth[hit].double()
    row = [
        float(quality[0]),
        float(quality[1:].mean()),
        float(d.std() / t.std()),
        float(torch.corrcoef(torch.stack([d, t]))[0, 1].nan_to_num(0)),  # NaN of a constant depth: none
        float(((d - t).abs() / t).mean()),
    ]
    return images, depth[None], row


if __name__ == "__main__":
    main()
