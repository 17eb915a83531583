"""The page: HTML, style, script and data in one file that makes no request."""

import base64
import hashlib
import html
import importlib.util
from pathlib import Path

from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.report.contents import Contents
from graph_slam_ros.report.packing import json_for_script, shown

_HERE = Path(__file__).resolve().parent
_NO_PLOTLY = "the report draws with plotly: pip install 'graph_slam_ros[report]' or pip install 'plotly>=7.1'"


def whole_page(made: Contents, script: str) -> str:
    """The whole HTML file; ``script`` is that of plotly."""
    own = (_HERE / "page.js").read_text(encoding="utf-8")
    rules = "; ".join(
        (
            "default-src 'none'",
            f"script-src 'unsafe-eval' {_hash(script)} {_hash(own)}",  # plotly compiles its shaders' glue
            "style-src 'unsafe-inline'",
            "img-src data: blob:",
            "base-uri 'none'",
            "form-action 'none'",
        )
    )
    title = html.escape(f"{shown(made.run.resolve().name)}: report")
    body = (_HERE / "page.html").read_text(encoding="utf-8")
    return "\n".join(
        (
            "<!DOCTYPE html>",
            '<html lang="en"><head><meta charset="utf-8">',
            f'<meta http-equiv="Content-Security-Policy" content="{html.escape(rules)}">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            f"<title>{title}</title>",
            f"<style>{(_HERE / 'page.css').read_text(encoding='utf-8')}</style></head>",
            body.strip(),
            f'<script type="application/json" id="data">{json_for_script(made.data)}</script>',
            f'<script type="text/plain" id="columns">{made.packing.block()}</script>',
            f"<script>{script}</script>",
            f"<script>{own}</script>",
            "</html>\n",
        )
    )


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
