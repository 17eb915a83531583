"""The report on a run: one HTML file that opens without a network."""

from pathlib import Path

from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.formats.durable import write_whole
from graph_slam_ros.runs.folder import page_mark
from graph_slam_ros.tools.report.contents import Contents
from graph_slam_ros.tools.report.page import whole_page


def write_report(made: Contents, script: str, out: Path) -> None:
    """Write the report on a run; ``script`` is that of plotly. Raises GraphSlamError: it cannot be written."""
    try:
        page = f"{whole_page(made, script)}\n".encode()
        write_whole(out, page + page_mark(page, out, made.run))
    except OSError as error:
        raise GraphSlamError(f"{out}: {error.strerror or error}") from None
