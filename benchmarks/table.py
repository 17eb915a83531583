"""Results as JSON and as Markdown tables; a table has its place in a document between two markers.

``python -m benchmarks.table RESULTS.json ...`` puts earlier results where they belong, into docs/*.md.
"""

import contextlib
import datetime
import json
import platform
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from benchmarks import robust_table
from benchmarks.contenders import OURS, OURS_AS_G2O
from benchmarks.fresh import ROOT

Row = dict[str, Any]

DOCUMENT = ROOT / "docs/benchmarks.md"
_ACCURACY = ROOT / "docs/accuracy.md"
_OTHER_HOMES = {"consistency": _ACCURACY, "marginals": _ACCURACY, "robust": ROOT / "docs/robustness.md"}
_OTHER_HOMES["lifelong"] = ROOT / "docs/lifelong.md"
_LIBRARIES = ("numpy", "scipy", "numba", "gtsam", "graphslam", "ros-jazzy-rclpy")

# The lowest cost that anybody has found, in our error map with the information matrices of the file.
_BEST_KNOWN = {
    "input_INTEL": 215.83,
    "intel_943": 546.461,
    "M3500": 137.913,
    "manhattanOlson3500": 146.077,
    "sphere2500": 1351.36,
    "parking-garage": 1.26838,
    "torus3D": 24234.71,
    "smallGrid3D": 1033.894,
    "ring": 11.1631,
    "victoria_park": 6184.12,
    "w10000": 289.7259,
}


def results(programme: str, rows: Sequence[Row], about: str = "") -> Row:
    """Rows with what they were measured by, on, and when."""
    libraries = [*_versions(), *(() if programme.startswith("node-") else _pinned())]
    return {
        "programme": programme,
        "about": about,
        "date": datetime.date.today().isoformat(),
        "machine": f"{_cpu()}, Python {platform.python_version()}, {', '.join(libraries)}",
        "rows": list(rows),
    }


def finish(measured: Row, path: Path | None) -> None:
    """Print a table, and keep the results where that was asked for."""
    print(markdown(measured))
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(measured, indent=1) + "\n", encoding="utf-8")


def markdown(measured: Row) -> str:
    """The results of a programme, and below them how and on what they were measured."""
    told = _repeated(measured["rows"]) if "repetitions" not in measured["about"] else ""
    about = "".join(f"{text}; " for text in (measured["about"], told) if text)
    columns = _TABLES.get(measured["programme"], _as_it_is)
    return f"{columns(measured['rows'])}\n\n{about}{measured['date']}, {measured['machine']}."


def into_document(measured: Row) -> None:
    """Put a table between its markers, in the place of an earlier one."""
    document = _OTHER_HOMES.get(measured["programme"], DOCUMENT)
    begin, end = (mark.format(measured["programme"]) for mark in ("<!-- {}: begin -->", "<!-- {}: end -->"))
    text = document.read_text(encoding="utf-8")
    head, rest = text.split(begin)
    _, tail = rest.split(end)
    document.write_text(f"{head}{begin}\n{markdown(measured)}\n{end}{tail}", encoding="utf-8")


def _online(rows: Sequence[Row]) -> str:
    names = (
        "graph",
        "poses, edges",
        "who",
        "CPU s",
        "median ms",
        "p99 ms",
        "worst ms",
        "chi2 (of best)",
        "in its own map",
    )
    lines = []
    for row in rows:
        ours = _of_ours(row, rows)
        times = [
            _with_ratio(row, ours, "total_s", 1.0, 2),
            _with_ratio(row, ours, "median_s", 1e3, 3),
            _with_ratio(row, ours, "p99_s", 1e3, 2),
            _with_ratio(row, ours, "worst_s", 1e3, 1),
        ]
        lines.append([*_heading(row, rows), *times, *_costs(row, rows)])
    return _table(names, lines)


def _batch(rows: Sequence[Row]) -> str:
    names = (
        "graph",
        "poses, edges",
        "who",
        "CPU s",
        "of it building",
        "iterations",
        "chi2 (of best)",
        "in its own map",
    )
    lines = []
    for row in rows:
        seconds = _with_ratio(row, _of_ours(row, rows), "total_s", 1.0, 3)
        about = [seconds, f"{row['build_s']:.3f}", str(row["iterations"])]
        lines.append([*_heading(row, rows), *about, *_costs(row, rows)])
    return _table(names, lines)


def _consistency(rows: Sequence[Row]) -> str:
    names = ("world", "settings", "seeds", "NEES of", "mean", "expected", "99.9 % band", "", "within 3 sigma")
    lines = []
    for row in rows:
        seeds = f"{row['first']} to {row['first'] + row['seeds'] - 1}"
        band, verdict = f"{row['band'][0]:.3f} to {row['band'][1]:.3f}", "inside" if row["inside"] else "outside"
        within = f"{100.0 * row['within']:.2f} % of {row['coordinates']}"
        about = [row["world"], row["settings"], seeds, row["what"]]
        lines.append([*about, f"{row['mean']:.3f}", str(row["expected"]), band, verdict, within])
    return _table(names, lines)


def _marginals(rows: Sequence[Row]) -> str:
    names = (
        "graph",
        "poses, edges",
        "against",
        "largest difference",
        "bound",
        "",
        "CPU ms",
        "theirs, ms",
        "ours / theirs",
    )
    lines = []
    for row in rows:
        about = [row["graph"], f"{row['poses']}, {row['edges']}", row["against"]]
        difference = "" if row["difference"] is None else f"{row['difference']:.1e}"
        bound = f"{row['bound']:.1e}" if difference else f"{row['bound']:g}x"
        verdict = "fulfilled" if row["fulfilled"] else "not fulfilled"
        times = ["", "", ""]
        if "ours_s" in row:
            theirs = row.get("gtsam_s", row.get("iteration_s"))
            times = [f"{1e3 * row['ours_s']:.2f}", f"{1e3 * theirs:.2f}", f"{row['ours_s'] / theirs:.3f}"]
        lines.append([*about, difference, bound, verdict, *times])
    return _table(names, lines)


def _robust(rows: Sequence[Row]) -> str:
    lines = _table(robust_table.NAMES, list(robust_table.lines(rows)))
    return f"{lines}\n\nWhat of ours misses what is asked:\n\n{robust_table.missed(rows)}"


def _as_it_is(rows: Sequence[Row]) -> str:
    """Rows whose keys are the names of the columns."""
    names = list(dict.fromkeys(name for row in rows for name in row))
    return _table(names, [[_cell(row.get(name)) for name in names] for row in rows])


def _cell(value: Any) -> str:
    """A number with three digits that count."""
    if isinstance(value, float):
        return f"{value:,.0f}" if abs(value) >= 100.0 else f"{value:.3g}"
    return "" if value is None else f"{value:,}" if isinstance(value, int) else str(value)


_TABLES: dict[str, Callable[[Sequence[Row]], str]] = {
    "online": _online,
    "update": _online,
    "batch": _batch,
    "consistency": _consistency,
    "marginals": _marginals,
    "robust": _robust,
}


def _heading(row: Row, rows: Sequence[Row]) -> list[str]:
    """Graph, size and who; the graph is named in the first of its lines."""
    first = next(other for other in rows if other["graph"] == row["graph"]) is row
    size = f"{row['poses']}, {row['edges']}"
    return [row["graph"] if first else "", size if first else "", row["who"]]


def _of_ours(row: Row, rows: Sequence[Row]) -> Row | None:
    """What a peer is compared with: ours on the same graph, in space against g2o with its weights."""
    same = {other["who"]: other for other in rows if other.get("graph") == row.get("graph")}
    ours = same.get(OURS_AS_G2O, same[OURS]) if row["who"].startswith("g2o") else same[OURS]
    return None if ours["fault"] else ours


def _with_ratio(row: Row, ours: Row | None, key: str, scale: float, digits: int) -> str:
    """A number, and for a peer in brackets what part of it ours is."""
    text = f"{scale * row[key]:.{digits}f}"
    if ours is None or row["fault"] or row["who"].startswith(OURS) or not row[key]:
        return text
    return f"{text} ({ours[key] / row[key]:.2f}x)"


def _costs(row: Row, rows: Sequence[Row]) -> list[str]:
    """The cost in our error map and in the contender's own, or instead why there is none."""
    if row["chi2"] is None:
        return [row["fault"], ""]
    ours, own = _cost(row, rows, "relative"), _cost(row, rows, row["error_map"])
    return [f"{ours}, {row['fault']}" if row["fault"] else ours, own]


def _cost(row: Row, rows: Sequence[Row], error_map: str) -> str:
    """A cost, and in brackets how many times the lowest known it is."""
    same = (other for other in rows if all(other[key] == row[key] for key in ("graph", "reached")))
    found = [other["chi2"][error_map] for other in same if other["chi2"]]
    if row["whole"] and error_map == "relative" and row["graph"] in _BEST_KNOWN:
        found.append(_BEST_KNOWN[row["graph"]])
    return f"{row['chi2'][error_map]:.4f} ({row['chi2'][error_map] / min(found):.4f})"


def _repeated(rows: Sequence[Row]) -> str:
    times = max((row.get("reps", 1) for row in rows), default=1)
    return f"medians of {times} repetitions" if times > 1 else ""


def _table(names: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    rule = ["---"] * len(names)
    return "\n".join(f"| {' | '.join(line)} |" for line in (names, rule, *lines))


def _cpu() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        return next(line.split(":")[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def _versions() -> Iterator[str]:
    """Of ours the revision."""
    described = subprocess.run(
        ["git", "describe", "--always", "--dirty"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    yield f"graph_slam_ros {described.stdout.strip() or version('graph_slam_ros')}"
    for name in _LIBRARIES:
        with contextlib.suppress(PackageNotFoundError):
            yield f"{name} {version(name)}"


def _pinned() -> Iterator[str]:
    """The versions in g2o's environment, which is not this one."""
    text = (ROOT / "benchmarks/requirements-g2o.txt").read_text(encoding="utf-8")
    return (line.replace("==", " ") for line in text.splitlines() if line.startswith("g2o"))


if __name__ == "__main__":
    for source in sys.argv[1:]:
        found = json.loads(Path(source).read_text(encoding="utf-8"))
        for measured in found if isinstance(found, list) else [found]:
            into_document(measured)
