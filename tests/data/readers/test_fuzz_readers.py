"""Damage at random: every reader either reads a dataset or says in one line which file is wrong."""

import json
import random
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import abo_fixtures
import clevr_fixtures
import posed_fixtures
from data_fixtures import FAR, NEAR, write_srn
from nerfdiff.data.readers.abo_materials import ABOMaterials
from nerfdiff.data.readers.abo_renders import ABORenders
from nerfdiff.data.readers.clevr3d import Clevr3DReader
from nerfdiff.data.readers.posed_images import PosedImagesReader
from nerfdiff.data.readers.srn import SRNReader
from nerfdiff.data.scene import SceneReader
from nerfdiff.inspection.all_views import refuse_missing_files
from nerfdiff.utils.errors import ConfigError, DataError

MUTATIONS_PER_READER = 80


@dataclass(frozen=True)
class Case:
    write: Callable[[Path], object]
    read: Callable[[Path, Path], SceneReader]
    """From the dataset's folder and one for indexes."""


def write_srn_per_view(root: Path) -> None:
    """The flavour with a K for each view, and with ground truth."""
    write_srn(root, {"train": 2}, views=3, truth=True)
    for scene in (root / "cars_train").iterdir():
        (scene / "intrinsics.txt").unlink()
        (scene / "intrinsics").mkdir()
        for k in range(3):
            (scene / f"intrinsics/{k:06d}.txt").write_text("50.0 0 27.0\n0 50.0 21.5\n0 0 1\n")


def read_abo_renders(root: Path, index: Path) -> ABORenders:
    sizes = {"train": 1, "val": 0, "test": 0}
    return ABORenders(root, "train", 3.2, 6.7, abo_fixtures.DISTANCE, "auto", 0, sizes, index)


def read_abo_materials(root: Path, index: Path) -> ABOMaterials:
    settings = {"environment": "all", "depth_kind": "z", "missing_items": "error", "val_fraction": 0.0, "split_seed": 0}
    return ABOMaterials(root, "train", 2.45, 7.45, abo_fixtures.DISTANCE, "auto", index_dir=index, **settings)


CASES = {
    "srn": Case(
        lambda root: write_srn(root, {"train": 2}, views=3, truth=True),
        lambda root, _: SRNReader(root, "cars", "train", NEAR, FAR),
    ),
    "srn_per_view": Case(write_srn_per_view, lambda root, _: SRNReader(root, "cars", "train", NEAR, FAR)),
    "abo_renders": Case(
        lambda root: abo_fixtures.write_renders(root, items=2, views=4, size=(24, 24), bits=16), read_abo_renders
    ),
    "abo_materials": Case(
        lambda root: abo_fixtures.write_materials(root, train=2, test=0, views=3, size=24, environments=("0", "1")),
        read_abo_materials,
    ),
    "clevr3d": Case(
        lambda root: clevr_fixtures.write_clevr3d(root, scenes=2, height=60, width=80),
        lambda root, _: Clevr3DReader(root, "train", {"train": [0, 2]}, max_objects=5, **clevr_fixtures.SETTINGS),
    ),
    "nerfstudio": Case(
        lambda root: [
            posed_fixtures.write_nerfstudio(root / f"train/s{k}", views=3, seed=k, k1=-0.1 * k) for k in range(2)
        ],
        lambda root, _: PosedImagesReader(root, "train", **posed_fixtures.SETTINGS),
    ),
    "blender": Case(
        lambda root: posed_fixtures.write_blender(root, views=(3, 2, 2)),
        lambda root, _: PosedImagesReader(root, "train", **posed_fixtures.SETTINGS),
    ),
}
NUMBER = re.compile(r"-?\d+\.?\d*(?:[eE][-+]?\d+)?")
ODD_NUMBERS = ("nan", "inf", "-1", "0", "1e300", "1e-300", "1" * 400, "x", "")
ODD_VALUES = (None, True, "x", -1, 0, 1e300, float("nan"), 10**400, [], {}, [[1]], "a\0b", "../..", "\ud800")


def truncate(rng: random.Random, file: Path) -> None:
    content = file.read_bytes()
    file.write_bytes(content[: rng.randrange(len(content))])


def flip_bits(rng: random.Random, file: Path) -> None:
    content = bytearray(file.read_bytes())
    for _ in range(rng.randint(1, 8)):
        content[rng.randrange(len(content))] ^= 1 << rng.randrange(8)
    file.write_bytes(content)


def empty(rng: random.Random, file: Path) -> None:
    file.write_bytes(b"")


def garbage(rng: random.Random, file: Path) -> None:
    file.write_bytes(rng.randbytes(rng.randint(1, 300)))


def delete(rng: random.Random, file: Path) -> None:
    file.unlink()


def become_folder(rng: random.Random, file: Path) -> None:
    file.unlink()
    file.mkdir()


def swap(rng: random.Random, file: Path) -> None:
    """Exchange the contents with any other file of the dataset."""
    other = rng.choice([f for f in sorted(file.parents[1].rglob("*")) if f.is_file()])
    here, there = file.read_bytes(), other.read_bytes()
    file.write_bytes(there)
    other.write_bytes(here)


def rename(rng: random.Random, file: Path) -> None:
    file.rename(file.with_name(rng.choice(["7", "stray", "000009", f"x{file.stem}"]) + file.suffix))


def odd_number(rng: random.Random, file: Path) -> None:
    """Replace a number of a text, or a key, or anything in between."""
    text = file.read_text()
    found = list(NUMBER.finditer(text)) if NUMBER.search(text) else [re.match("", text)]
    hit = rng.choice(found)
    file.write_text(text[: hit.start()] + rng.choice(ODD_NUMBERS) + text[hit.end() :])


def odd_value(rng: random.Random, file: Path) -> None:
    """Remove or replace an entry somewhere in a JSON tree."""
    tree = json.loads(file.read_text())
    node = tree
    while True:
        key = rng.choice(list(node)) if isinstance(node, dict) else rng.randrange(len(node))
        if not isinstance(node[key], (dict, list)) or not node[key] or rng.random() < 0.3:
            break
        node = node[key]
    if rng.random() < 0.4:
        del node[key]
    else:
        node[key] = rng.choice(ODD_VALUES)
    file.write_text(json.dumps(tree))


def odd_image(rng: random.Random, file: Path) -> None:
    """A whole image of another size or kind."""
    shape = rng.choice([(1, 1), (24, 24), (40, 56), (60, 80), (7, 90)])
    mode = rng.choice(["1", "L", "P", "LA", "RGB", "RGBA", "CMYK", "I;16", "I", "F"])
    image = Image.new(mode, shape[::-1])
    image.save(file, format="TIFF" if mode in ("I", "F", "CMYK") else "PNG")


def odd_array(rng: random.Random, file: Path) -> None:
    """Another type, shape or value within an npz."""
    with np.load(file) as arrays:
        content = dict(arrays)
    key = rng.choice(sorted(content))
    array = content.pop(key)
    change = rng.randrange(6)
    if change == 0:
        array = array[..., :-1]
    elif change == 1:
        array = array.astype(np.float64)
        array.flat[rng.randrange(array.size)] = rng.choice([np.nan, np.inf, -1.0, 1e300])
    elif change == 2:
        array = array.astype(rng.choice([str, object, complex, bool]))
    elif change == 3:
        array = array.ravel()
    elif change == 4:
        array = array[:0]
    if change < 5:
        content[key] = array
    np.savez(file, **content)


ANY_FILE = (truncate, flip_bits, empty, garbage, delete, become_folder, swap, rename)
BY_SUFFIX = {
    ".png": (odd_image,),
    ".jpg": (odd_image,),
    ".txt": (odd_number, odd_number),
    ".csv": (odd_number,),
    ".json": (odd_number, odd_value, odd_value),
    ".npz": (odd_array, odd_array),
}


def mutate(rng: random.Random, root: Path) -> str:
    """Damage one file; returns what was done."""
    # first the kind of file, so that the few that describe all others are hit often
    files = [file for file in sorted(root.rglob("*")) if file.is_file()]
    kind = rng.choice(sorted({(file.suffix, file.parent.name if file.suffix == ".png" else "") for file in files}))
    file = rng.choice([f for f in files if (f.suffix, f.parent.name if f.suffix == ".png" else "") == kind])
    extra = BY_SUFFIX.get(file.suffix, ())
    mutation = rng.choice(extra if extra and rng.random() < 0.5 else ANY_FILE)
    mutation(rng, file)
    return f"{mutation.__name__} {file.relative_to(root)}"


def restore(root: Path, whole: dict[Path, bytes]) -> None:
    for path in sorted(root.rglob("*")):
        if path not in whole and path.is_file():
            path.unlink()
        elif path in whole and path.is_dir():
            path.rmdir()
    for file, content in whole.items():
        if not file.is_file() or file.read_bytes() != content:
            file.write_bytes(content)


def read_all(reader: SceneReader) -> None:
    """Read everything, and check what no dataset may have, whatever lay on disk."""
    reader.fingerprint()
    for index in range(len(reader)):
        names, listing = reader.view_names(index), reader.listing(index)
        scene = reader.load(index, truth=True)
        assert tuple(listing.files) == names and all(file.is_file() for f in listing.files.values() for file in f)
        np.testing.assert_allclose(scene.cameras.c2w, listing.c2w, rtol=1e-5, atol=1e-5)
        assert scene.views == names and len(set(names)) == len(names) > 0
        height, width = scene.pixels.shape[-2:]
        assert scene.pixels.shape == (len(names), 3, height, width)
        assert (scene.cameras.height, scene.cameras.width) == (height, width)
        assert scene.cameras.c2w.isfinite().all() and scene.cameras.K.isfinite().all()
        assert (scene.cameras.K[:, [0, 1], [0, 1]] > 0).all() and 0 < scene.near < scene.far < np.inf
        identity = scene.cameras.c2w[:, :3, :3] @ scene.cameras.c2w[:, :3, :3].mT
        assert (identity - identity.new_tensor(np.eye(3))).abs().max() < 0.01
        for truth in (scene.mask, scene.depth):
            assert truth is None or truth.shape == (len(names), height, width)
        assert scene.depth is None or (scene.depth.isfinite().all() and scene.depth.min() >= 0)


@pytest.mark.parametrize("name", CASES)
def test_every_file_that_a_view_lacks_is_noticed_without_reading_it(tmp_path, name):
    case, root = CASES[name], tmp_path / "data"
    case.write(root)
    files = list(case.read(root, tmp_path / "index").listing(0).files.values())[1]
    assert len(files) > (name in ("srn", "srn_per_view", "abo_materials", "clevr3d", "nerfstudio"))
    for k, file in enumerate(files):
        content = file.read_bytes()
        file.unlink()
        with pytest.raises(DataError) as error:
            refuse_missing_files(case.read(root, tmp_path / f"index{k}").listing(0))
        assert file.stem in str(error.value) or re.search(r"a file: 1\b", str(error.value))
        file.write_bytes(content)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", CASES)
def test_damage_is_survived_or_named(tmp_path, name):
    case, root = CASES[name], tmp_path / "data"
    case.write(root)
    whole = {file: file.read_bytes() for file in sorted(root.rglob("*")) if file.is_file()}
    read_all(case.read(root, tmp_path / "index"))
    surprises, refused = [], 0
    for seed in range(MUTATIONS_PER_READER):
        restore(root, whole)
        what = mutate(random.Random(f"{name} {seed}"), root)
        try:
            read_all(case.read(root, tmp_path / f"index{seed}"))
        except (DataError, ConfigError) as error:
            refused += 1
            if str(root) not in str(error) or "\n" in str(error):
                surprises.append(f"{seed}: {what}: message without a file, or of several lines: {error}")
        except Exception as error:
            surprises.append(f"{seed}: {what}: {type(error).__module__}.{type(error).__name__}: {error}"[:300])
    assert not surprises, f"{len(surprises)} surprises\n" + "\n".join(surprises)
    assert refused > MUTATIONS_PER_READER / 3  # most damage does matter
