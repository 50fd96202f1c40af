"""Panels of the chart, which share a frontier: one device, and one set of test images."""

from collections.abc import Sequence
from dataclasses import dataclass

from nerfdiff.results.frame import Configuration
from nerfdiff.results.row import ResultRow
from nerfdiff.results.text import one_line

UNKNOWN = "device not recorded"
LONGEST = 200  # letters of a name


@dataclass(frozen=True)
class Panel:
    """Configurations that were measured on one device, on the same images.

    Args:
        cpu: whether the device is one.
        members: their numbers.
        views: test images of a scene, on average; None where it was not recorded.
    """

    device: str
    cpu: bool
    data: str
    dataset: str | None
    image_size: tuple[int, ...]
    views: float | None
    members: tuple[int, ...]


def panels_of(found: Sequence[Configuration]) -> list[Panel]:
    """The panels, that with the most configurations first."""
    groups: dict[tuple[str, tuple], list[int]] = {}
    for number, configuration in enumerate(found):
        groups.setdefault((configuration.runs[0].device or UNKNOWN, _test(configuration.row)), []).append(number)
    tests = list(dict.fromkeys(test for _, test in groups))
    names = [_name(found[groups[next(key for key in groups if key[1] == test)][0]].row) for test in tests]
    # other splits of one dataset have one name: their digests tell them apart
    names = [
        f"{n}, split {str(test[1])[:6]}" if names.count(n) > 1 else n for n, test in zip(names, tests, strict=True)
    ]
    named = dict(zip(tests, names, strict=True))
    panels = []
    for (device, test), members in groups.items():
        row = found[members[0]].row
        views = row.n_views / row.n_scenes if row.n_views and row.n_scenes else None
        size = tuple(row.image_size or ())
        panels.append(Panel(device, row.device == "cpu", named[test], row.dataset, size, views, tuple(members)))
    return sorted(panels, key=lambda panel: -len(panel.members))


def _test(row: ResultRow) -> tuple:
    return row.dataset, row.split_sha256, row.n_scenes, row.n_views, tuple(row.image_size or ())


def _name(row: ResultRow) -> str:
    name = one_line(row.dataset or "data not recorded", LONGEST)
    size = row.image_size and f"{'×'.join(map(str, row.image_size))} pixels"
    scenes = row.n_scenes and f"{row.n_scenes} scene{'s' * (row.n_scenes > 1)}"
    views = row.n_views and f"{row.n_views} views"
    return ", ".join(filter(None, (name, size, scenes, views)))
