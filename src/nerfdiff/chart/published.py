"""Values from papers, as markers of another kind."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from nerfdiff.chart.panels import Panel
from nerfdiff.utils.errors import ConfigError

NOT_METRICS = ("method", "dataset", "image_size", "source")
SPEEDS = ("encode_s", "render_s")
LITERATURE = Path(__file__).with_name("literature.yaml")


def read_published(path: str | Path | None) -> dict[str, Any]:
    """The values, speeds and sources of a YAML file, for `published_for`; None is the file that comes along.

    Raises:
        ConfigError: the file cannot be read, or holds something else.
    """
    path = LITERATURE if path is None else Path(path)
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, yaml.YAMLError) as error:
        raise ConfigError(f"published={path} cannot be read ({' '.join(str(error).split())})") from error
    kinds = {"sources": dict, "speeds": dict, "values": list}
    if not isinstance(content, dict) or {key: type(value) for key, value in content.items()} != kinds:
        raise ConfigError(f"published={path}: expected sources, speeds and values, in the form of {LITERATURE}")
    return content


def published_for(
    panel: Panel,
    values: Sequence[Mapping[str, Any]],
    speeds: Mapping[str, Mapping[str, Any]],
    sources: Mapping[str, str],
) -> list[dict[str, Any]]:
    """The entries for the panel's dataset: {method, metrics, costs, source, same_size}.

    Seconds per scene are those of encoding and of rendering as many views as a scene of the panel has; without a
    published speed there are no costs.

    Raises:
        ConfigError: an entry names no source, or a speed is for no method.
    """
    strangers = speeds.keys() - {entry["method"] for entry in values}
    if strangers:
        raise ConfigError(f"published.speeds: no entry of published.values is for {', '.join(sorted(strangers))}")
    found = []
    for entry in values:
        _source(entry, sources, f"published.values: {entry['method']}")
        if panel.dataset is None or panel.dataset.partition("/")[0] != entry["dataset"]:
            continue
        size = entry["image_size"]
        size = (size, size) if isinstance(size, int) else tuple(size)
        speed, costs, source = speeds.get(entry["method"]), {}, entry["source"]
        said = [sources[source]]
        if speed is not None:
            said.append("speed: " + _source(speed, sources, f"published.speeds: {entry['method']}"))
            costs = {name: speed[name] for name in SPEEDS}
            if panel.views is not None:
                costs["scene_s"] = speed["encode_s"] + panel.views * speed["render_s"]
        found.append(
            {
                "method": entry["method"],
                "metrics": {name: value for name, value in entry.items() if name not in NOT_METRICS},
                "costs": costs,
                "source": "; ".join(said),
                "image_size": "×".join(map(str, size)),
                "same_size": size == panel.image_size,
            }
        )
    return found


def _source(entry: Mapping[str, Any], sources: Mapping[str, str], where: str) -> str:
    if entry.get("source") not in sources:
        raise ConfigError(f"{where}: source {entry.get('source')!r} is not under published.sources")
    return sources[entry["source"]]
