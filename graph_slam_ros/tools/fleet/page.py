"""The page on a fleet: each recording and setting, the worst first, with links to the reports."""

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jinja2

from graph_slam_ros import __version__
from graph_slam_ros.formats.durable import write_whole
from graph_slam_ros.tools.fleet.store import ERRORS, JOBS, REPORT
from graph_slam_ros.tools.report.page import style

PAGE = "index.html"
_COLUMNS = (
    ("rmse_m", "error [m]", 3),
    ("rpe_m_per_m", "drift [m/m]", 4),
    ("nees", "NEES", 1),
    ("map_rmse_m", "map [m]", 3),
    ("keyframes", "keyframes", 0),
    ("cpu_s", "CPU [s]", 1),
    ("memory_mib", "memory [MiB]", 0),
)
_WIDTH, _HEIGHT = 120, 20
_MOST = 1000  # a browser shows as many at once


def write_page(folder: Path, rows: Sequence[Mapping[str, Any]]) -> Path:
    """Write the page of a fleet's table into its folder."""
    template = Path(__file__).with_name("page.html").read_text(encoding="utf-8")
    reports = {row["key"] for row in rows if (folder / JOBS / row["key"] / REPORT).is_file()}
    shown = [dict(row) for row in sorted(rows, key=_badness)[:_MOST]]
    for row in shown:
        row["report"] = f"{JOBS}/{row['key']}/{REPORT}" if row["key"] in reports else ""
        row["line"] = _line(row.get(ERRORS) or ())
    page = jinja2.Environment(autoescape=True).from_string(template)
    text = page.render(
        name=folder.name,
        style=style(),
        count=len(rows),
        states=Counter(row["state"] for row in rows),
        has_reports=bool(reports),
        has_errors=any(row.get("rmse_m") is not None for row in rows),
        columns=_COLUMNS,
        rows=shown,
        width=_WIDTH,
        height=_HEIGHT,
        version=__version__,
    )
    write_whole(folder / PAGE, text.encode())
    return folder / PAGE


def _badness(row: Mapping[str, Any]) -> tuple[int, float, str, str]:
    """Failed ones first, then incomplete ones, then by error."""
    states = {"failed": 0, "incomplete": 1}
    return states.get(row["state"], 2), -(row.get("rmse_m") or 0.0), row["recording"], row["setting"]


def _line(values: Sequence[float]) -> str:
    """The corners of a line through values from left to right, from 0 to the largest."""
    if len(values) < 2 or not max(values) > 0.0:
        return ""
    step, top = _WIDTH / (len(values) - 1), max(values)
    return " ".join(f"{k * step:.1f},{_HEIGHT - 1 - (_HEIGHT - 2) * v / top:.1f}" for k, v in enumerate(values))
