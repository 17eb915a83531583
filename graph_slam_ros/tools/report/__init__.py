"""The report on a run: one HTML file that opens without a network."""

from pathlib import Path

from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.formats.durable import write_whole
from graph_slam_ros.runs.folder import page_mark
from graph_slam_ros.tools.report.contents import Contents, read_contents
from graph_slam_ros.tools.report.page import plotly, whole_page


def write_report(
    run: Path,
    out: Path,
    truth: str | None = None,
    other: Path | None = None,
    plan: Path | None = None,
    topic: str = "",
    *,
    align: bool = True,
) -> Contents:
    """Write the report on a run; returns what it shows. As ``read_contents``.

    Raises
    ------
    GraphSlamError
        It cannot be written, too, or plotly is not installed.
    """
    if out.suffix != ".html":
        raise GraphSlamError(f"{out}: a report is a .html file")
    script = plotly()
    made = read_contents(run, truth, other, plan, topic, align=align)
    try:
        page = f"{whole_page(made, script)}\n".encode()
        write_whole(out, page + page_mark(page, out, run))
    except OSError as error:
        raise GraphSlamError(f"{out}: {error.strerror or error}") from None
    return made
