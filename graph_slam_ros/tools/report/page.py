"""The page: HTML, style, script and data in one file that makes no request."""

import base64
import hashlib
import html
import importlib.util
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.formats.durable import write_whole
from graph_slam_ros.runs.folder import page_mark
from graph_slam_ros.tools.report.contents import Contents
from graph_slam_ros.tools.report.packing import json_for_script

_HERE = Path(__file__).resolve().parent
_BAR, _PANEL = "<!-- bar -->", "<!-- panel -->"
_NO_PLOTLY = "the report draws with plotly: pip install 'graph_slam_ros[report]' or pip install 'plotly>=7.1'"


@dataclass(frozen=True, slots=True)
class Panel:
    """A further part of the page, which asks the server that the page is from.

    Attributes
    ----------
    bar, html : of the part, above the map and below it
    css, script : of both; the script is run before that of the page
    data : as JSON, in the element ``panel-data``
    """

    bar: str
    html: str
    css: str
    script: str
    data: Any


def style() -> str:
    """Return the style of the pages."""
    return (_HERE / "page.css").read_text(encoding="utf-8")


def whole_page(made: Contents, script: str, panel: Panel | None = None) -> str:
    """The whole HTML file; ``script`` is that of plotly."""
    own = (_HERE / "page.js").read_text(encoding="utf-8")
    scripts = [script, *([panel.script] if panel else []), own]
    server = "'self'" if panel else "'none'"
    rules = (  # plotly compiles its shaders' glue
        f"default-src 'none'; script-src 'unsafe-eval' {' '.join(map(_hash, scripts))};"
        f" connect-src {server}; style-src 'unsafe-inline'; img-src data: blob:;"
        " base-uri 'none'; form-action 'none'"
    )
    body = (_HERE / "page.html").read_text(encoding="utf-8")
    for place, part in ((_BAR, panel.bar), (_PANEL, panel.html)) if panel else ():
        body = body.replace(place, part)
    return "\n".join(
        (
            "<!DOCTYPE html>",
            '<html lang="en"><head><meta charset="utf-8">',
            f'<meta http-equiv="Content-Security-Policy" content="{html.escape(rules)}">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            f"<title>{html.escape(made.data['title'])}</title>",
            f"<style>{style()}{panel.css if panel else ''}</style></head>",
            body.strip(),
            f'<script type="application/json" id="data">{json_for_script(made.data)}</script>',
            f'<script type="text/plain" id="columns">{made.packing.block()}</script>',
            f'<script type="application/json" id="panel-data">{json_for_script(panel.data)}</script>' if panel else "",
            *(f"<script>{one}</script>" for one in scripts),
            "</html>",
        )
    )


def write_report(made: Contents, script: str, out: Path) -> None:
    """Write the report on a run; ``script`` is that of plotly. Raises GraphSlamError: it cannot be written."""
    try:
        page = f"{whole_page(made, script)}\n".encode()
        write_whole(out, page + page_mark(page, out, made.run))
    except OSError as error:
        raise GraphSlamError(f"{out}: {error.strerror or error}") from None


def plotly() -> str:
    """The JavaScript of the installed plotly; it is not imported. Raises GraphSlamError where there is none."""
    found = importlib.util.find_spec("plotly")
    places = found.submodule_search_locations if found is not None else None
    file = Path(places[0]) / "package_data" / "plotly.min.js" if places else None
    if file is None or not file.is_file():
        raise GraphSlamError(_NO_PLOTLY)
    text = file.read_text(encoding="utf-8").strip()
    return text.replace("</script", "<\\/script").replace("<!--", "<\\!--")


def _hash(script: str) -> str:
    """The name of a script for the Content-Security-Policy: no other one is run."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()}'"
