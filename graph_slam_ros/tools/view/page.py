"""The page of a report with the panel of edits."""

from pathlib import Path

from graph_slam_ros.tools.report.contents import Contents
from graph_slam_ros.tools.report.page import Panel, plotly, whole_page
from graph_slam_ros.tools.view.workbench import Workbench

_HERE = Path(__file__).resolve().parent


def page_of(made: Contents, work: Workbench) -> str:
    """The whole HTML of the page. Raises GraphSlamError where plotly is not installed."""
    names = "edits_bar.html", "edits.html", "edits.css", "edits.js"
    bar, html, css, script = ((_HERE / name).read_text(encoding="utf-8") for name in names)
    return whole_page(made, plotly(), Panel(bar, html, css, script, work.page_data))
