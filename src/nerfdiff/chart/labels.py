"""Names of configurations: by the settings in which they differ."""

from collections import Counter
from collections.abc import Hashable, Iterable, Iterator, Sequence

from nerfdiff.results.frame import Configuration

FIELDS = (
    "model", "field", "backend", "compile", "precision", "scenes_at_once", "samples_per_ray", "K", "prior", "weights",
    "ckpt_sha256",
)  # fmt: skip
SETTLED_BY = {
    "model": ("ckpt",), "field": ("ckpt",), "ckpt_sha256": ("ckpt",), "K": ("budget.views",),
    "samples_per_ray": ("uniform_samples", "importance_samples"),
}  # fmt: skip
"""Overrides which say what a field of the row says, and more."""
DIGITS = 8  # of a digest
PARTS = 16  # of a key or path at most, before the whole is told
ROW = "row."
CKPT = "ckpt"  # the one path that is told
RUN = ROW + "run_id"  # where nothing else differs

Settings = dict[str, str]


def labels_of(found: Sequence[Configuration], unnamed: Sequence[str]) -> list[Settings]:
    """For each configuration the values of what not all have alike: its strategy, overrides, and what it ran with.

    That some lack an override on whose value the others agree is no difference, unless it alone tells configurations
    apart: defaults and the constants of a sweep need no name. Keys and checkpoints are as short as tells them apart.

    Args:
        unnamed: overrides, or what they begin with up to a dot, that likewise count only where nothing else differs.
    """
    settings = [_settings(configuration) for configuration in found]
    keys = list(dict.fromkeys(key for values in settings for key in values if key != RUN))
    twice = _told_twice(settings, keys)
    where = [key for key in keys if any(f"{key}.".startswith(f"{name}.") for name in unnamed)]
    named = [key for key in keys if key not in {*twice, *where}]
    told = ["strategy", *_telling(settings, [key for key in named if key != "strategy"], [*twice, *where, RUN])]
    short = _shortened(told, ".")
    models = _shortened({values[CKPT] for values in settings if CKPT in values}, "/")
    return [
        {short[key]: models[values[key]] if key == CKPT else values[key] for key in told if key in values}
        for values in settings
    ]


def names_of(labels: Sequence[Settings]) -> list[str]:
    """For each configuration of a panel its strategy, and as few labels as no other of that strategy has all."""
    alike: dict[str, list[int]] = {}
    for number, values in enumerate(labels):
        alike.setdefault(values["strategy"], []).append(number)
    names = [""] * len(labels)
    for strategy, members in alike.items():
        for number, told in _told_of(members, labels):
            short = _shortened(labels[number], ".")
            words = [f"{short[key]}={value}" for key, value in labels[number].items() if key in told]
            names[number] = " ".join([strategy, *words])
    return names


def _told_of(members: Sequence[int], labels: Sequence[Settings]) -> Iterator[tuple[int, set[str]]]:
    """For each member the labels to tell: that which fewest share with it, and so on among these.

    Members go through it together as long as they tell the same, so that each is counted a few times in all.
    """
    groups: list[tuple[list[int], list[int], set[str]]] = [(list(members), list(members), {"strategy"})]
    while groups:
        asking, among, told = groups.pop()
        if len(among) == 1:
            yield from ((number, told - {"strategy"}) for number in asking)
            continue
        counts = Counter((key, value) for number in among for key, value in labels[number].items() if key not in told)
        chosen: dict[tuple[str, str], list[int]] = {}
        for number in asking:
            left = [item for item in labels[number].items() if item[0] not in told]
            if left:
                chosen.setdefault(min(left, key=counts.__getitem__), []).append(number)
            else:
                yield number, told - {"strategy"}
        having: dict[tuple[str, str], list[int]] = {item: [] for item in chosen}
        for number in among:
            for item in labels[number].items():
                if item in having:
                    having[item].append(number)
        groups += [(own, having[item], told | {item[0]}) for item, own in chosen.items()]


def _settings(configuration: Configuration) -> Settings:
    row = configuration.row
    values = {"strategy": row.strategy or "?"}
    for word in configuration.settings:
        key, _, value = word.lstrip("+").partition("=")
        if key != "strategy":
            values[key] = value
    fields = {ROW + name: _said(value) for name in FIELDS if (value := getattr(row, name)) is not None}
    return values | fields | {RUN: row.run_id}


def _said(value: object) -> str:
    return value[:DIGITS] if isinstance(value, str) and len(value) == 64 else str(value)


def _told_twice(settings: Sequence[Settings], keys: Sequence[str]) -> list[str]:
    """Keys of which another says as much.

    What it ran with says more than an override of that name, which may be `auto`, wherever that differs at all.
    """
    several = [key for key in keys if _differs(settings, key)]
    ran = [key for key in several if key.startswith(ROW)]
    twice = [key.removeprefix(ROW) for key in ran if key.removeprefix(ROW) in keys]
    overridden = {_numbers(v.get(key) for v in settings) for key in several if key not in {*ran, *twice}}
    for key in ran:
        by = SETTLED_BY.get(key.removeprefix(ROW), ())
        if _numbers(v.get(key) for v in settings) in overridden or (by and _settled(settings, key, by)):
            twice.append(key)
    return twice


def _settled(settings: Sequence[Settings], key: str, by: Sequence[str]) -> bool:
    """Return true if some have the overrides `by`, and these agree in `key` where they agree in them."""
    known: dict[tuple, str | None] = {}
    given = [values for values in settings if all(name in values for name in by)]
    return bool(given) and all(
        known.setdefault(tuple(values[name] for name in by), values.get(key)) == values.get(key) for values in given
    )


def _telling(settings: Sequence[Settings], keys: Sequence[str], spare: Sequence[str]) -> list[str]:
    """The `keys` with several values; and of the others, then of `spare`, those that it takes to tell all apart."""
    told = [key for key in keys if _differs(settings, key)]
    known = _numbers(tuple(values.get(key) for key in ("strategy", *told)) for values in settings)
    for key in [*(key for key in keys if key not in told), *spare]:
        if len(set(known)) == len(settings):
            break
        finer = _numbers((number, values.get(key)) for number, values in zip(known, settings, strict=True))
        if len(set(finer)) > len(set(known)):
            told.append(key)
            known = finer
    return told


def _differs(settings: Sequence[Settings], key: str) -> bool:
    return len({values[key] for values in settings if key in values}) > 1


def _numbers(values: Iterable[Hashable]) -> tuple[int, ...]:
    """Each distinct value as a number, by first appearance: equal for two keys that tell the same apart."""
    numbers: dict[Hashable, int] = {}
    return tuple(numbers.setdefault(value, len(numbers)) for value in values)


def _shortened(words: Iterable[str], separator: str) -> dict[str, str]:
    """Each word by its last part, with as many before it as it takes to be the only one; the whole if it takes many."""
    short = {word: word.rstrip(separator).rsplit(separator, 1)[-1] for word in words}
    for parts in range(2, PARTS + 2):
        counts = Counter(short.values())
        clashing = [word for word, name in short.items() if counts[name] > 1 and name != word]
        if not clashing:
            break
        for word in clashing:
            short[word] = word if parts > PARTS else separator.join(word.rsplit(separator, parts)[-parts:])
    return short
