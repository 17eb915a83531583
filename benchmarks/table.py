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
    if begin not in text:
        print(f"{document.name} has no place for {measured['programme']}", file=sys.stderr)
        return
    head, rest = text.split(begin)
    _, tail = rest.split(end)
    document.write_text(f"{head}{begin}\n{markdown(measured)}\n{end}{tail}", encoding="utf-8")


def _online(rows: Sequence[Row]) -> str:
    """A line for each graph: ours, a peer, and what part of its times ours takes; a table for each peer."""
    return "\n\n".join(_online_against(peer, rows) for peer in _peers(rows) or [""])


def _online_against(peer: str, rows: Sequence[Row]) -> str:
    names = ["graph", "poses, edges", "ours, CPU s", f"{peer}, CPU s", "part", "p99, part", "worst, part"]
    lines = []
    for graph, by in _by_graph(rows):
        ours, theirs = by[OURS], by.get(peer, by[OURS])
        parts = [_part(ours, theirs, key) for key in ("total_s", "p99_s", "worst_s")]
        size = f"{ours['poses']}, {ours['edges']}"
        best = [_of_best(one, rows) for one in (ours, theirs)]
        lines.append([graph, size, _seconds(ours, 2), _seconds(theirs, 2), *parts, *best])
    return _table([*names, "of best, ours", peer], lines)


def _batch(rows: Sequence[Row]) -> str:
    """A line for each graph: seconds of each, and in brackets what part of a peer's ours takes."""
    peers = _peers(rows)
    lines = []
    for graph, by in _by_graph(rows):
        ours, found = by[OURS], []
        for peer in peers:
            same = by.get(OURS_AS_G2O, ours) if peer.startswith("g2o") else ours
            part = _part(same, by[peer], "total_s") if peer in by else ""
            found.append((_seconds(by[peer], 3) if peer in by else "") + (f" ({part})" if part else ""))
        lines.append([graph, _seconds(ours, 3), *found, _of_best(ours, rows)])
    return _table(["graph", "ours", *peers, "of best, ours"], lines)


def _consistency(rows: Sequence[Row]) -> str:
    """A line for each world and kind of vertex, a column of means for each range of seeds; outside the band is said."""
    seeds = list(dict.fromkeys((row["first"], row["first"] + row["seeds"] - 1) for row in rows))
    found: dict[tuple[str, ...], dict[int, str]] = {}
    for row in rows:
        key = row["world"], row["what"], str(row["expected"])
        found.setdefault(key, {})[row["first"]] = f"{row['mean']:.3f}" + ", outside its band" * (not row["inside"])
    names = ["world", "NEES of", "expected", *(f"mean, seeds {first} to {last}" for first, last in seeds)]
    return _table(names, [[*key, *(by.get(first, "") for first, _ in seeds)] for key, by in found.items()])


def _marginals(rows: Sequence[Row]) -> str:
    """A line for each graph: largest differences from each reference, and times; what is not fulfilled is said."""
    against = list(dict.fromkeys(row["against"] for row in rows if row["difference"] is not None))
    found: dict[str, dict[str, str]] = {}
    for row in rows:
        line, bad = found.setdefault(row["graph"], {}), ", not fulfilled" * (not row["fulfilled"])
        if row["difference"] is not None:
            line[row["against"]] = f"{row['difference']:.1e}{bad}"
        if "gtsam_s" in row:
            line |= {"ours, CPU ms": f"{1e3 * row['ours_s']:.2f}", "gtsam, ms": f"{1e3 * row['gtsam_s']:.2f}"}
        elif "ours_s" in row:
            line["ours, CPU ms"] = f"{1e3 * row['ours_s']:.2f}"
            line["iteration"] = f"{row['ours_s'] / row['iteration_s']:.3f}{bad}"
    names = [*against, "ours, CPU ms", "gtsam, ms", "iteration"]
    return _table(["graph", *names], [[graph, *(by.get(name, "") for name in names)] for graph, by in found.items()])


def _robust(rows: Sequence[Row]) -> str:
    lines = _table(*robust_table.table(rows))
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


def _by_graph(rows: Sequence[Row]) -> Iterator[tuple[str, dict[str, Row]]]:
    """The rows of each graph by who."""
    for graph in dict.fromkeys(row["graph"] for row in rows):
        yield graph, {row["who"]: row for row in rows if row["graph"] == graph}


def _peers(rows: Sequence[Row]) -> list[str]:
    return [who for who in dict.fromkeys(row["who"] for row in rows) if not who.startswith(OURS)]


def _seconds(row: Row, digits: int) -> str:
    """CPU time, or why there is none; what was reached and is no optimum is said."""
    if row["chi2"] is None:
        return str(row["fault"])
    return f"{row['total_s']:.{digits}f}" + (f", {row['fault']}" if row["fault"] else "")


def _part(ours: Row, theirs: Row, key: str) -> str:
    """What part of a peer's number ours is; empty where either failed."""
    is_void = ours is theirs or ours["fault"] or theirs["fault"] or not theirs[key]
    return "" if is_void else f"{ours[key] / theirs[key]:.2f}"


def _of_best(row: Row, rows: Sequence[Row]) -> str:
    """The cost in our error map, as a multiple of the lowest that is known."""
    if row["chi2"] is None:
        return ""
    same = (other for other in rows if all(other[key] == row[key] for key in ("graph", "reached")))
    found = [other["chi2"]["relative"] for other in same if other["chi2"]]
    if row["whole"] and row["graph"] in _BEST_KNOWN:
        found.append(_BEST_KNOWN[row["graph"]])
    return f"{row['chi2']['relative'] / min(found):.4f}"


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
