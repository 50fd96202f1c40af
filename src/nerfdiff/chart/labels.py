"""How configurations are called: by the settings in which they differ."""

from collections import Counter
from collections.abc import Sequence

from nerfdiff.results.frame import Configuration

FIELDS = (
    "model", "field", "backend", "compile", "precision", "scenes_at_once", "samples_per_ray", "K", "prior", "weights",
    "ckpt_sha256",
)  # fmt: skip
DIGITS = 8  # of a digest
ROW = "row."


def labels_of(found: Sequence[Configuration]) -> list[dict[str, str]]:
    """For each configuration the values of what not all have alike: its strategy, overrides, and what it ran with.

    Keys are as short as tells them apart. A field of the row is left out where an override says the same.
    """
    settings = [_settings(configuration) for configuration in found]
    keys = dict.fromkeys(key for values in settings for key in values)
    words = {key: {values.get(key) for values in settings} for key in keys}
    # that a strategy has no K, say, is no more than its name says
    several = [key for key in keys if len(words[key] - ({None} if key.startswith(ROW) else set())) > 1]
    overridden = {_partition(settings, key) for key in several if not key.startswith(ROW)}
    several = [key for key in several if not (key.startswith(ROW) and _partition(settings, key) in overridden)]
    told = ["strategy", *(key for key in several if key != "strategy")]
    short = _shortened(told)
    return [{short[key]: values[key] for key in told if key in values} for values in settings]


def _settings(configuration: Configuration) -> dict[str, str]:
    values = {"strategy": configuration.row.strategy or "?"}
    for word in configuration.settings:
        key, _, value = word.lstrip("+").partition("=")
        if key != "strategy":
            values[key] = value
    row = configuration.row
    return values | {ROW + name: _said(value) for name in FIELDS if (value := getattr(row, name)) is not None}


def _said(value: object) -> str:
    return value[:DIGITS] if isinstance(value, str) and len(value) == 64 else str(value)


def _partition(settings: Sequence[dict[str, str]], key: str) -> tuple[int, ...]:
    """Which configurations have the same value: equal for two keys that tell the same apart."""
    numbers: dict[str | None, int] = {}
    return tuple(numbers.setdefault(values.get(key), len(numbers)) for values in settings)


def _shortened(keys: Sequence[str]) -> dict[str, str]:
    """Each key by its last part, with as many before it as it takes to be the only one."""
    short = {key: key.rsplit(".", 1)[-1] for key in keys}
    while clashing := [name for name, count in Counter(short.values()).items() if count > 1]:
        longer = {k: ".".join(k.split(".")[-name.count(".") - 2 :]) for k, name in short.items() if name in clashing}
        if all(short[key] == name for key, name in longer.items()):
            break
        short |= longer
    return short
