"""The notebook, run from its first cell to its last on a small budget."""

import re
from pathlib import Path

import nbformat
import torch
from nbclient import NotebookClient

from nerfdiff.cameras import Cameras
from nerfdiff.data.readers.srn import SRNReader
from nerfdiff.fit.saved_field import load_field
from nerfdiff.metrics.image import psnr

NOTEBOOKS = Path(__file__).parents[1] / "notebooks"
METHODS = ("single-image NeRF", "CDM", "refined field")
SMALL = """
out = {out!r}
strategy = ["strategy=ngd_current", "strategy.lr_planes=1.0e-2"]
budget = {{"steps": 2, "sampler_steps": 4, "inner_steps": 3, "rays": 64, "views": 3}}
seed = 0
"""


def test_from_picture_to_field(tmp_path):
    notebook = nbformat.read(NOTEBOOKS / "one_picture.ipynb", as_version=4)
    (parameters,) = (cell for cell in notebook.cells if "parameters" in cell.metadata.get("tags", []))
    assert set(re.findall(r"^(\w+) =", parameters.source, re.M)) == set(re.findall(r"^(\w+) =", SMALL, re.M))
    parameters.source = SMALL.format(out=str(tmp_path / "out"))
    NotebookClient(notebook, timeout=240, resources={"metadata": {"path": str(tmp_path)}}).execute()

    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    printed = "".join(output.text for output in outputs if output.output_type == "stream")
    scores = {name: float(value) for name, value in re.findall(r"^(.+): ([\d.]+) dB$", printed, re.M)}
    reader = SRNReader(root=tmp_path / "out" / "cars", category="cars", split="test", near=0.8, far=1.8)
    truth = reader.load(0, range(0, 64, 8)).images
    empty = psnr(torch.ones_like(truth), truth).mean().item()
    assert tuple(scores) == METHODS and all(score > empty + 3 for score in scores.values())
    assert scores["refined field"] != scores["single-image NeRF"]
    assert "status: ok; 3 virtual views, 2 steps of t" in printed

    source = reader.load(0, [64])
    saved = load_field(tmp_path / "out" / "field.safetensors")
    torch.testing.assert_close(saved.field.cameras.K, source.cameras.K, rtol=1e-3, atol=0)
    own = Cameras(torch.eye(4)[None, None], source.cameras.K[None], 64, 64)
    with torch.no_grad():
        rendered = saved.field.render(saved.renderer, own).images[0]
    assert psnr(rendered, source.images).item() > empty + 6
    shown = sum("image/png" in output.get("data", {}) for output in outputs)
    assert shown == len(list((tmp_path / "out").glob("*.png"))) == 7


def test_notebooks_are_stored_without_outputs():
    for path in sorted(NOTEBOOKS.glob("*.ipynb")):
        cells = nbformat.read(path, as_version=4).cells
        stored = [cell for cell in cells if cell.cell_type == "code" and (cell.outputs or cell.execution_count)]
        assert not stored, f"{path} has outputs: jupyter nbconvert --clear-output --inplace {path}"
