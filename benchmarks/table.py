"""Results as JSON and as Markdown tables; a table has its place in a document between two markers.

``python -m benchmarks.table RESULTS.json ...`` puts earlier results where they belong, into docs/*.md.
"""

import contextlib
import datetime
import json
import platform
import subprocess
import sys
from collections.abc import Iterator, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from benchmarks.fresh import ROOT

Row = dict[str, Any]
"""A line of a table, by the names of its columns."""

_LIBRARIES = ("numpy", "scipy", "numba", "gtsam", "ros-jazzy-rclpy")


def results(programme: str, rows: Sequence[Row], about: str = "") -> Row:
    """Rows with what they were measured by, on, and when."""
    return {
        "programme": programme,
        "about": about,
        "date": datetime.date.today().isoformat(),
        "machine": f"{_cpu()}, Python {platform.python_version()}, {', '.join(_versions())}",
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
    names = list(dict.fromkeys(name for row in measured["rows"] for name in row))
    lines = [names, ["---"] * len(names), *([_cell(row.get(name)) for name in names] for row in measured["rows"])]
    table = "\n".join(f"| {' | '.join(line)} |" for line in lines)
    about = f"{measured['about']}; " if measured["about"] else ""
    return f"{table}\n\n{about}{measured['date']}, {measured['machine']}."


def _cell(value: Any) -> str:
    """A number with three digits that count."""
    if isinstance(value, float):
        return f"{value:,.0f}" if abs(value) >= 100.0 else f"{value:.3g}"
    return "" if value is None else f"{value:,}" if isinstance(value, int) else str(value).replace("|", "/")


def into_document(measured: Row) -> None:
    """Put a table between its markers, in the place of an earlier one."""
    begin, end = (mark.format(measured["programme"]) for mark in ("<!-- {}: begin -->", "<!-- {}: end -->"))
    for document in sorted((ROOT / "docs").glob("*.md")):
        text = document.read_text(encoding="utf-8")
        if begin in text:
            head, rest = text.split(begin)
            _, tail = rest.split(end)
            document.write_text(f"{head}{begin}\n{markdown(measured)}\n{end}{tail}", encoding="utf-8")
            return
    print(f"docs/ has no place for {measured['programme']}", file=sys.stderr)


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


if __name__ == "__main__":
    for source in sys.argv[1:]:
        found = json.loads(Path(source).read_text(encoding="utf-8"))
        for measured in found if isinstance(found, list) else [found]:
            into_document(measured)
