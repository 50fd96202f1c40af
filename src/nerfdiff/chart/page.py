"""The page: one HTML file that needs neither network nor any other file, except for the pictures in full."""

import html
from base64 import b64encode
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any

from nerfdiff.chart.payload import to_json
from nerfdiff.utils.errors import ConfigError
from nerfdiff.utils.files import write_text

PARTS = Path(__file__).parent / "page"
SCRIPTS = (
    *(
        "state",
        "colours",
        "axes",
        "legend",
        "plot",
        "tip",
        "spending",
        "details",
        "pick",
        "cards",
        "table",
        "stability",
    ),
    *("keys", "main"),
)


def write_page(path: Path, title: str, content: dict[str, Any]) -> None:
    """Write `content` (see `payload`) with plotly.js and DataTables as one HTML file.

    Raises:
        DataError: the file cannot be written.
        ConfigError: plotly or itables is not installed.
    """
    libraries = (
        _libraries()
        if content["panels"] or content["stability"]
        else dict.fromkeys(("plotly", "table_style", "table_script"), "")
    )
    parts = {
        "title": html.escape(title),
        "style": _part("style.css"),
        "data": to_json(content),
        "script": "\n".join(_part(f"{name}.js") for name in SCRIPTS),
    }
    write_text(path, Template(_part("page.html")).substitute(parts | libraries))


def _libraries() -> dict[str, str]:
    """Read the JavaScript libraries of charts and tables; a page that has neither goes without these megabytes."""
    try:
        import itables
        from plotly.offline import get_plotlyjs
    except ImportError as error:
        raise ConfigError(f"the chart's page needs plotly and itables ({error}): pip install plotly itables") from error
    tables = files(itables) / "html"
    return {
        "plotly": get_plotlyjs().replace("</script", "<\\/script"),
        "table_style": (tables / "dt_bundle.css").read_text(encoding="utf-8"),
        "table_script": b64encode((tables / "dt_bundle.js").read_bytes()).decode(),
    }


def _part(name: str) -> str:
    return (PARTS / name).read_text(encoding="utf-8")
