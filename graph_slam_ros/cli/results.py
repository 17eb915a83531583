"""What commands show of a run beside their answer: its picture, and the command that is next."""

import importlib.util
from pathlib import Path
from typing import Any

from graph_slam_ros.cli import console
from graph_slam_ros.errors import GraphSlamError


def draw(run: Path, truth: Any = None, out: Path | None = None, *, align: bool = True, quiet: bool = False) -> None:
    """Draw a run in addition to other output. A failure to draw does not fail the command."""
    from graph_slam_ros.analysis.plots import draw_run
    from graph_slam_ros.runs.folder import PICTURE

    picture = out or run / PICTURE
    try:
        draw_run(run, truth, picture, align=align)
    except GraphSlamError as error:
        if out is not None:  # it was asked for
            raise
        return console.warn(f"no picture: {error}")
    if not quiet:
        console.show(f"picture in {picture}")


def suggest_next(run: Path, doubtful: Path | None = None) -> None:
    """Name the next command; ``doubtful`` is a recording whose result is incomplete, or comes with a warning."""
    if doubtful is not None:
        return console.then(f"{console.command('check', doubtful)} (what is wrong with the recording, and the remedy)")
    if importlib.util.find_spec("plotly") is None:
        what = f"{console.command('explain', run)} (which measurements are believed, and why)"
    else:
        what = f"{console.command('report', run)} (one page: the map, and why each edge is in or out)"
    console.then(f"{what}; with a ground truth: {console.command('evaluate', run, '--truth', 'TRUTH')}")
