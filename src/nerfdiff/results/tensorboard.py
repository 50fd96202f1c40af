"""TensorBoard's tabs beside scalars and images: hyperparameters, texts and a first screen."""

import math
import re
from collections.abc import Mapping, Sequence
from typing import Any

from torch.utils.tensorboard import SummaryWriter
from torch.utils.tensorboard.summary import hparams as hparams_summaries

from nerfdiff.results.text import markdown_cell

Layout = Mapping[str, Mapping[str, Sequence[str]]]
"""The charts of the custom scalars tab: category, then chart, then patterns of the tags that it draws."""


def begin(writer: SummaryWriter, hparams: Mapping[str, Any], texts: Mapping[str, str], layout: Layout) -> None:
    """Make a run a line of the HPARAMS tab, whose metrics are all scalars of the run, and lay out its first screen.

    The tab's columns are collected from all runs below TensorBoard's folder: these need not have the same ones.

    Args:
        hparams: what tells it from other runs; None is left out.
        texts: Markdown, by tag.
    """
    told = {name: _plain(value) for name, value in hparams.items() if value is not None}
    _, start, _ = hparams_summaries(told, {})
    # torch offers it only together with a list of columns, of which TensorBoard takes the first run's for all
    writer.file_writer.add_summary(start)
    for tag, text in texts.items():
        writer.add_text(tag, text)
    charts = {
        category: {title: ["Multiline", list(tags)] for title, tags in named.items()}
        for category, named in layout.items()
    }
    writer.add_custom_scalars(charts)


def end(writer: SummaryWriter, succeeded: bool) -> None:
    """Say in the HPARAMS tab that the run is over, and how it went."""
    from tensorboard.compat.proto.summary_pb2 import Summary, SummaryMetadata
    from tensorboard.plugins.hparams import api_pb2, metadata, plugin_data_pb2

    status = api_pb2.STATUS_SUCCESS if succeeded else api_pb2.STATUS_FAILURE
    content = plugin_data_pb2.HParamsPluginData(
        session_end_info=plugin_data_pb2.SessionEndInfo(status=status), version=metadata.PLUGIN_DATA_VERSION
    )
    plugin = SummaryMetadata.PluginData(plugin_name=metadata.PLUGIN_NAME, content=content.SerializeToString())
    value = Summary.Value(tag=metadata.SESSION_END_INFO_TAG, metadata=SummaryMetadata(plugin_data=plugin))
    writer.file_writer.add_summary(Summary(value=[value]))


def overridden(words: Sequence[str], ignored: Sequence[str]) -> dict[str, str]:
    """Overrides of a command as hyperparameters: `key=value` by its key, without those that say where, not what.

    Args:
        ignored: keys, or what they begin with up to a dot.
    """
    pairs = dict(word.lstrip("+").split("=", 1) for word in words if "=" in word and not word.startswith("~"))
    return {key: value for key, value in pairs.items() if not any(f"{key}.".startswith(f"{i}.") for i in ignored)}


def table(values: Mapping[str, Any]) -> str:
    """Names and values as a Markdown table."""
    lines = [f"| {markdown_cell(name)} | {_cell(value)} |" for name, value in values.items() if value is not None]
    return "\n".join(["| | |", "|---|---|", *lines])


def code(text: str, language: str = "") -> str:
    """Text as it is, in Markdown."""
    fence = "`" * max(3, 1 + max(map(len, re.findall("`+", text)), default=0))
    return f"{fence}{language}\n{text}\n{fence}"


def _plain(value: Any) -> bool | float | str:
    """A finite number where it is one, also in words; else a string."""
    if isinstance(value, bool):
        return value
    try:
        return number if math.isfinite(number := float(value)) else str(value)
    except (TypeError, ValueError):
        return str(value)


def _cell(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, float) else markdown_cell(str(value))
