"""The text files of ABO's material set: the split of its objects, and the views of each."""

import csv
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from nerfdiff.data.formats.json_files import entry, matrix, read_list
from nerfdiff.data.formats.posed_files import read_text
from nerfdiff.utils.errors import DataError, some

KEY_FILE = "metadata.json"
SPLIT_FILE = "train_test_split.csv"
SPLITS = ("train", "val", "test")
ITEM_COLUMNS = ("model", "item", "item_id", "id", "object")


def find_split_file(root: Path) -> Path:
    """`train_test_split.csv` in `root`, in its `abo-benchmark-material`, or in any one folder of it.

    Raises:
        DataError: `root` is missing, or none of these is there.
    """
    if not root.is_dir():
        raise DataError(f"{root}: no such folder; set data.root to the folder that holds {SPLIT_FILE}")
    folders = [root, root / "abo-benchmark-material", *sorted(path for path in root.iterdir() if path.is_dir())]
    for folder in folders:
        if (folder / SPLIT_FILE).is_file():
            return folder / SPLIT_FILE
    found = sorted(entry.name for entry in root.iterdir())
    raise DataError(
        f"{root}: {f'found only {some(found)}' if found else 'the folder is empty'}; looked for {SPLIT_FILE} in it, in "
        "abo-benchmark-material and in every other folder in it; set data.root to the folder that holds it"
    )


def read_split(file: Path) -> dict[str, list[str]]:
    """Objects of each split, sorted: from a table of which one column holds train, val or test, in any case.

    The object's name is in the column that the header calls so, or else in the first other column.

    Raises:
        DataError: no such table, or an object in two splits; the message names the line.
    """
    expected = "expected a table with a column of train and test, and one of names of objects"
    lines = csv.reader(read_text(file, expected).splitlines(), skipinitialspace=True)
    rows = [[cell.strip() for cell in row] for row in lines if any(cell.strip() for cell in row)]
    columns = {len(row) for row in rows}
    if len(columns) != 1 or columns == {1}:
        raise DataError(f"{file}: {expected}, found rows of {' and '.join(map(str, sorted(columns))) or 'no'} cells")
    words = [[cell.lower() in SPLITS for cell in column] for column in zip(*rows, strict=True)]
    split_column = max(range(len(words)), key=lambda column: sum(words[column]))
    header = [] if words[split_column][0] else [cell.lower() for cell in rows.pop(0)]
    if not rows:
        raise DataError(f"{file}: {expected}, found no object")
    named = [column for column, cell in enumerate(header) if cell in ITEM_COLUMNS]
    item_column = named[0] if named else min(column for column in range(len(words)) if column != split_column)
    split_of: dict[str, str] = {}
    for row in rows:
        item, split = row[item_column], row[split_column].lower()
        if split not in SPLITS or not item or split_of.setdefault(item, split) != split:
            raise DataError(f"{file}: {expected}, each object in one of {', '.join(SPLITS)}; found {','.join(row)!r}")
    return {split: sorted(item for item in split_of if split_of[item] == split) for split in SPLITS}


@dataclass(frozen=True)
class MaterialViews:
    """The views of a `metadata.json`, in the order of their numbers."""

    numbers: tuple[int, ...]
    poses: Float[np.ndarray, "views 4 4"]
    K: Float[np.ndarray, "views 3 3"]

    @staticmethod
    def read(folder: Path) -> "MaterialViews":
        """Parse `<folder>/metadata.json`: "views" is a list of {"index", "pose" of 16 numbers, "K" of 9}.

        Raises:
            DataError: the file is missing, damaged or incomplete; the message names the view.
        """
        file = folder / KEY_FILE
        views = read_list(file, "views", "one view per image")
        parsed = {}
        for k, view in enumerate(views):
            where = f"{file}: views[{k}]"
            number = entry(view, "index", int, where)
            if number in parsed:
                raise DataError(f"{where}: index {number} is there twice")
            pose = matrix(entry(view, "pose", list, where), 4, 4, f"{where}: pose")
            K = matrix(entry(view, "K", list, where), 3, 3, f"{where}: K")
            parsed[number] = pose, K
        numbers = tuple(sorted(parsed))
        return MaterialViews(numbers, *(np.stack([parsed[n][j] for n in numbers]) for j in (0, 1)))


def numbered_files(folder: Path, suffixes: tuple[str, ...], numbers: tuple[int, ...]) -> list[Path]:
    """The files whose names end in these numbers, in the order of the numbers.

    Raises:
        DataError: the folder is missing, or holds other numbers than these.
    """
    if not folder.is_dir():
        raise DataError(f"{folder}: no such folder; expected {' or '.join(suffixes)} files that end in a view's number")
    files = {}
    for file in sorted(folder.iterdir()):
        digits = re.search(r"\d+$", file.stem)
        if digits and file.suffix.lower() in suffixes and file.name[0] != ".":
            files.setdefault(int(digits[0]), file)
    known = set(numbers)
    if files.keys() != known:
        raise DataError(
            f"{folder}: {len(files)} files and {len(known)} views of {KEY_FILE} do not match by number; views without "
            f"a file: {_numbers(known - files.keys())}; files without a view: {_numbers(files.keys() - known)}"
        )
    return [files[number] for number in numbers]


def _numbers(numbers: set[int]) -> str:
    return ", ".join(map(str, sorted(numbers)[:8])) or "none"
