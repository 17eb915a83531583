"""The page on a fleet: each recording and setting, the worst first, with links to the reports."""

from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any
from urllib.parse import quote

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
_STYLE = """
table { width: 100% } td { overflow-wrap: anywhere }
.failed { color: light-dark(#a40000, #ff8a80) } .incomplete { color: light-dark(#7a4a00, #ffc46b) }
svg { vertical-align: middle; fill: none; stroke: currentColor }
"""
_WIDTH, _HEIGHT = 120.0, 20.0
_MOST = 1000  # a browser shows as many at once


def write_page(folder: Path, rows: Sequence[Mapping[str, Any]]) -> Path:
    """Write the page of a fleet's table into its folder."""
    ordered = sorted(rows, key=_badness)
    failed = sum(row["state"] == "failed" for row in rows)
    incomplete = sum(row["state"] == "incomplete" for row in rows)
    head = f"{len(rows)} runs: {len(rows) - failed - incomplete} done, {incomplete} incomplete, {failed} failed"
    parts = [
        "<!doctype html><html lang=en><meta charset=utf-8><meta name=viewport content='width=device-width'>",
        "<meta http-equiv=Content-Security-Policy content=\"default-src 'none'; style-src 'unsafe-inline'\">",
        f"<title>{escape(folder.name)}</title><style>{style()}{_STYLE}</style><main><h1>{escape(folder.name)}</h1><p>{head}.</p>",
        "<h2>Runs, the worst first</h2>",
        _more(folder, rows),
        _table(
            ["recording", "setting", "state", *(title for _, title, _ in _COLUMNS), "error over the drive", "why"],
            [_run(folder, row) for row in ordered[:_MOST]],
        ),
        f"<p>graph_slam_ros {escape(__version__)}</p></main></html>",
    ]
    write_whole(folder / PAGE, "\n".join(parts).encode())
    return folder / PAGE


def _more(folder: Path, rows: Sequence[Mapping[str, Any]]) -> str:
    """Say what the table of runs lacks, and how to get it."""
    lines = []
    if len(rows) > _MOST:
        lines.append(f"These are {_MOST} of {len(rows)} runs. table.parquet has all of them.")
    if not any((folder / JOBS / row["key"] / REPORT).is_file() for row in rows):
        lines.append("The runs have no reports: fleet replay --report writes them.")
    if not any(row.get("rmse_m") is not None for row in rows):
        lines.append("Nothing was compared with a truth: fleet replay --truth gives errors.")
    return "".join(f"<p class=note>{escape(line)}</p>" for line in lines)


def _badness(row: Mapping[str, Any]) -> tuple[int, float, str, str]:
    """Failed ones first, then incomplete ones, then by error."""
    states = {"failed": 0, "incomplete": 1}
    error = row.get("rmse_m")
    return states.get(row["state"], 2), -(error or 0.0), row["recording"], row["setting"]


def _run(folder: Path, row: Mapping[str, Any]) -> list[str]:
    name = escape(row["recording"])
    if (folder / JOBS / row["key"] / REPORT).is_file():
        address = quote("/".join((JOBS, row["key"], REPORT)))
        name = f"<a href='{address}'>{name}</a>"
    numbers = [_number("" if row.get(k) is None else f"{row[k]:.{digits}f}") for k, _, digits in _COLUMNS]
    state = row["state"]
    return [
        f"<td>{name}",
        f"<td>{escape(row['setting'])}",
        f"<td class={escape(state)}>{escape(state)}",
        *numbers,
        f"<td>{_sparkline(row.get(ERRORS) or ())}",
        f"<td>{escape(row.get('reason') or '')}",
    ]


def _number(text: str) -> str:
    return f"<td class=number>{text}"


def _table(titles: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    head = "".join(f"<th scope=col>{escape(title)}" for title in titles)
    return f"<table><thead><tr>{head}<tbody>" + "".join(f"<tr>{''.join(row)}" for row in rows) + "</table>"


def _sparkline(values: Sequence[float]) -> str:
    """The values from left to right, from 0 to the largest, as a small picture."""
    if len(values) < 2 or not max(values) > 0.0:
        return ""
    step, top = _WIDTH / (len(values) - 1), max(values)
    points = " ".join(f"{k * step:.1f},{_HEIGHT - 1 - (_HEIGHT - 2) * v / top:.1f}" for k, v in enumerate(values))
    label = f"{values[0]:.3f} m to {values[-1]:.3f} m, at most {top:.3f} m"
    return (
        f"<svg width={_WIDTH:.0f} height={_HEIGHT:.0f} role=img aria-label='{label}'><title>{label}</title>"
        f"<polyline points='{points}'/></svg>"
    )
