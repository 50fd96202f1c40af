"""Scenes in SRN's layout as one small file, to be carried where 64 MiB is all, and back.

    python benchmarks/pack_scenes.py pack data/procedural/cars_64 .gpu/cars.zip --bits 2 --splits train val
    python benchmarks/pack_scenes.py unpack .gpu/cars.zip /tmp/cars

A scene is one lossless WebP of its views side by side. Rounding: with --bits N a colour below 255 becomes the next
multiple of 2^N, at most 256 − 2^N: it is up to 2^N − 1 of 255 brighter or darker; white stays white. Without it pixels
come back as they were. Masks, depths and whatever else lies beside images are left behind.
"""

import argparse
import io
import json
import zipfile
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path

import numpy as np
from PIL import Image

COLUMNS = 4


def packed(bits: int, root: Path, scene: Path) -> tuple[str, bytes, str]:
    """A scene's name, its views, and cameras."""
    views = sorted((scene / "rgb").glob("*.png"))
    images = [np.asarray(Image.open(view).convert("RGB")) for view in views]
    height, width, _ = images[0].shape
    images += [np.full_like(images[0], 255)] * (-len(images) % COLUMNS)
    rows = [np.concatenate(images[first : first + COLUMNS], 1) for first in range(0, len(images), COLUMNS)]
    atlas = io.BytesIO()
    Image.fromarray(rounded(np.concatenate(rows), bits)).save(atlas, "WEBP", lossless=True, quality=75, method=6)
    about = {"size": [height, width], "intrinsics": (scene / "intrinsics.txt").read_text()}
    about["poses"] = {view.stem: (scene / "pose" / f"{view.stem}.txt").read_text() for view in views}
    return str(scene.relative_to(root)), atlas.getvalue(), json.dumps(about)


def rounded(pixels: np.ndarray, bits: int) -> np.ndarray:
    """See above."""
    step = 1 << bits
    up = np.minimum((pixels.astype(int) + step - 1) // step * step, 256 - step)
    return np.where(pixels == 255, 255, up).astype(np.uint8)


def pack(root: Path, archive: Path, bits: int, splits: list[str] | None) -> None:
    found = sorted(path.parent for path in root.rglob("rgb") if path.is_dir())
    scenes = [s for s in found if splits is None or s.parent.name.rpartition("_")[2] in splits]
    archive.parent.mkdir(parents=True, exist_ok=True)
    with ProcessPoolExecutor() as pool, zipfile.ZipFile(archive, "w", zipfile.ZIP_LZMA) as file:
        for name, atlas, about in pool.map(partial(packed, bits, root), scenes, chunksize=8):
            file.writestr(f"{name}.webp", atlas, zipfile.ZIP_STORED)
            file.writestr(f"{name}.json", about)
    print(f"{len(scenes)} scenes, {archive.stat().st_size / 2**20:.1f} MiB: {archive}")


def unpacked(archive: Path, out: Path, name: str) -> None:
    """Write one scene."""
    with zipfile.ZipFile(archive) as file:
        about = json.loads(file.read(f"{name}.json"))
        atlas = np.asarray(Image.open(io.BytesIO(file.read(f"{name}.webp"))))
    scene, (height, width) = out / name, about["size"]
    for folder in ("rgb", "pose"):
        (scene / folder).mkdir(parents=True)
    (scene / "intrinsics.txt").write_text(about["intrinsics"])
    for number, (view, pose) in enumerate(about["poses"].items()):
        y, x = height * (number // COLUMNS), width * (number % COLUMNS)
        image = Image.fromarray(atlas[y : y + height, x : x + width])
        image.save(scene / "rgb" / f"{view}.png", compress_level=0)
        (scene / "pose" / f"{view}.txt").write_text(pose)


def unpack(archive: Path, out: Path) -> None:
    with zipfile.ZipFile(archive) as file:
        names = [name.removesuffix(".json") for name in file.namelist() if name.endswith(".json")]
    with ProcessPoolExecutor() as pool:
        list(pool.map(partial(unpacked, archive, out), names, chunksize=16))
    print(f"{len(names)} scenes: {out}")


def main(words: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    verbs = parser.add_subparsers(dest="verb", required=True)
    packing = verbs.add_parser("pack")
    packing.add_argument("root", type=Path)
    packing.add_argument("archive", type=Path)
    packing.add_argument("--bits", type=int, choices=range(5), default=0, help="of a colour to do without")
    packing.add_argument("--splits", nargs="+", help="train, val, test; default: all")
    unpacking = verbs.add_parser("unpack")
    unpacking.add_argument("archive", type=Path)
    unpacking.add_argument("out", type=Path)
    arguments = vars(parser.parse_args(words))
    {"pack": pack, "unpack": unpack}[arguments.pop("verb")](**arguments)


if __name__ == "__main__":
    main()
