"""Run notebooks and keep what they show: `make notebooks`, or `python notebooks/execute.py compare_strategies`."""

import base64
import io
import sys
from pathlib import Path

import nbformat
from nbclient import NotebookClient
from PIL import Image

HERE = Path(__file__).parent


def execute(path: Path) -> None:
    """Run a notebook and write its outputs into it, pictures with 256 colours, paths without this machine's folders."""
    notebook = nbformat.read(path, as_version=4)
    NotebookClient(notebook, timeout=3600, resources={"metadata": {"path": str(HERE)}}).execute()
    for cell in notebook.cells:
        cell.metadata.pop("execution", None)
        for output in cell.get("outputs", []):
            data = output.get("data", {})
            if png := data.get("image/png"):
                data["image/png"] = base64.b64encode(_small(base64.b64decode(png))).decode()
            for part in (output, data):
                for key in ("text", "text/plain", "text/html"):
                    if key in part:
                        part[key] = part[key].replace(str(HERE.parent), "..").replace(str(Path.home()), "~")
    nbformat.write(notebook, path)


def _small(png: bytes) -> bytes:
    image, file = Image.open(io.BytesIO(png)).convert("RGB"), io.BytesIO()
    image.thumbnail((900, 900))
    image.quantize(256, dither=Image.Dither.NONE).save(file, "PNG", optimize=True)
    return file.getvalue()


if __name__ == "__main__":
    for name in sys.argv[1:] or sorted(path.stem for path in HERE.glob("*.ipynb")):
        execute(HERE / f"{name}.ipynb")
        print(name, flush=True)
