"""JSON files of a dataset: what is in them is checked as it is taken out."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from nerfdiff.data.formats.posed_files import read_text
from nerfdiff.utils.errors import DataError


def read_json(path: Path, expected: str) -> dict[str, Any]:
    """The JSON object in a file.

    Raises:
        DataError: the file cannot be read or is no JSON object; the message says what was `expected` in it.
    """
    text = read_text(path, expected)
    try:
        value = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise DataError(f"{path}: {expected}, but it is not JSON ({error})") from error
    if not isinstance(value, dict):
        raise DataError(f"{path}: {expected}, found a {type(value).__name__}")
    return value


def read_list(path: Path, key: str, of: str) -> list[Any]:
    """The list under `key` of the JSON object in a file, which must not be empty.

    Raises:
        DataError: as `read_json`, or there is no such list; the message says what it was expected to be `of`.
    """
    values = entry(read_json(path, f"expected an object with a list {key!r}"), key, list, path)
    if not values:
        raise DataError(f"{path}: {key!r} is empty; expected {of}")
    return values


def entry(values: Any, key: str, kind: type | tuple[type, ...], where: str | Path) -> Any:
    """`values[key]`, which has to be of this type.

    Raises:
        DataError: `values` is no object, has no such key, or another type of value there.
    """
    if not isinstance(values, Mapping) or key not in values:
        raise DataError(f"{where}: expected a key {key!r} with {_named(kind)}; it is not there")
    if not isinstance(values[key], kind) or (isinstance(values[key], bool) and kind is not bool):
        raise DataError(f"{where}: expected {_named(kind)} as {key!r}, found {_short(values[key])}")
    return values[key]


def number(values: Any, key: str, where: str | Path, default: float | None = None) -> float:
    """The finite number `values[key]`, or `default` where the key is not there and a default is given.

    Raises:
        DataError: as `entry`, or the number is NaN or infinite.
    """
    if default is not None and isinstance(values, Mapping) and key not in values:
        return default
    value = entry(values, key, (int, float), where)
    if not -1e300 < value < 1e300:
        raise DataError(f"{where}: expected a finite number as {key!r}, found {_short(value)}")
    return float(value)


def optional_number(values: Any, key: str, where: str | Path) -> float | None:
    """The finite number `values[key]`; None where the key is not there or its value is null.

    Raises:
        DataError: the value is anything else.
    """
    return None if isinstance(values, Mapping) and values.get(key) is None else number(values, key, where)


def matrix(value: Any, rows: int, columns: int, where: str | Path) -> Float[np.ndarray, "rows columns"]:
    """Numbers as a matrix, whether nested by rows or in one row-major list.

    Raises:
        DataError: not so many numbers.
    """
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        array = None
    if array is None or array.shape not in ((rows, columns), (rows * columns,)):
        raise DataError(f"{where}: expected {rows}x{columns} numbers, found {_short(value)}")
    return array.reshape(rows, columns)


def _named(kind: type | tuple[type, ...]) -> str:
    last = kind[-1] if isinstance(kind, tuple) else kind
    names = {dict: "an object", list: "a list", int: "a whole number", float: "a number"}
    return names.get(last, f"a {last.__name__}")


def _short(value: Any, limit: int = 80) -> str:
    text = repr(value)
    return text if len(text) <= limit else f"{text[:limit]}…"
