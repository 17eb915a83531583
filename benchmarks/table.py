"""Tables of figures: their home is docs/figures/NAME.csv, and pages show them between two markers.

``python -m benchmarks.table`` writes the tables of README.md and docs/*.md anew. A row of a csv has three more columns:
when and on what it was measured, a note on that, which both stand below the table, and the command.
"""

import argparse
import contextlib
import csv
import datetime
import platform
import re
import shlex
import subprocess
import sys
from collections.abc import Collection, Iterator, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from benchmarks.fresh import ROOT

Row = dict[str, Any]
"""A line of a table, by the names of its columns."""

FIGURES = ROOT / "docs/figures"
PAGES = (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")))
MEASURED, NOTE, COMMAND = "measured", "note", "command"
_ASIDE = (MEASURED, NOTE, COMMAND)
_PLACE = re.compile(r"(<!-- (\S+): begin -->\n).*?(<!-- \2: end -->)", re.DOTALL)
_LIBRARIES = ("gtsam", "g2o-python", "ros-jazzy-rclpy")


def add_write(options: argparse.ArgumentParser) -> None:
    """Add ``--write``."""
    options.add_argument("--write", action="store_true", help="into docs/figures, and the table of the page anew")


def finish(name: str, rows: Sequence[Row], *, write: bool, note: str = "", keys: int = 1) -> None:
    """Print a table; if asked for write it, in the place of earlier rows that have the same first columns."""
    aside = {
        MEASURED: f"{datetime.date.today()}, {_cpu()}, Python {platform.python_version()}, {', '.join(_versions())}"
    }
    aside |= {NOTE: note, COMMAND: _command()}
    found = [{column: _cell(value) for column, value in row.items()} | aside for row in rows]
    print(markdown(found), flush=True)
    if write:
        store(name, {tuple(row.values())[:keys]: row for row in (*read(name), *found)}.values())
        write_pages()


def store(name: str, rows: Collection[dict[str, str]]) -> None:
    """Replace a table."""
    columns = dict.fromkeys(column for row in rows for column in row)
    with (FIGURES / f"{name}.csv").open("w", encoding="utf-8", newline="") as file:
        out = csv.DictWriter(file, sorted(columns, key=_ASIDE.__contains__), restval="", lineterminator="\n")
        out.writeheader()
        out.writerows(rows)


def read(name: str) -> list[dict[str, str]]:
    """Return the rows of a table; none if there is no such table yet."""
    path = FIGURES / f"{name}.csv"
    return list(csv.DictReader(path.read_text(encoding="utf-8").splitlines())) if path.exists() else []


def markdown(rows: Sequence[dict[str, str]]) -> str:
    """A table as a page shows it. What begins as the row before does not say so again."""
    columns = list(dict.fromkeys(column for row in rows for column in row if column not in _ASIDE))
    lines, before = [columns, ["---"] * len(columns)], ""
    for row in rows:
        first, *others = (row.get(column, "") for column in columns)
        lines.append(["" if first == before else first, *others])
        before = first
    table = "\n".join(f"| {' | '.join(map(_shown, line))} |" for line in lines)
    return f"{table}\n\n{'; '.join(_below(rows))}."


def _below(rows: Sequence[dict[str, str]]) -> Iterator[str]:
    """When and on what most was measured; of other rows when, and what is noted."""
    yield rows[0][MEASURED]
    said: dict[str, dict[str, None]] = {}
    for row in rows:
        day = row[MEASURED].partition(",")[0] if row[MEASURED] != rows[0][MEASURED] else ""
        if text := ", ".join(filter(None, (day, row[NOTE]))):
            said.setdefault(text, {})[_shown(next(iter(row.values())))] = None
    for text, names in said.items():
        yield (
            text
            if len(names) == len({_shown(next(iter(row.values()))) for row in rows})
            else f"{', '.join(names)}: {text}"
        )


def _shown(cell: str) -> str:
    return f"{int(cell):,}" if cell.isdigit() else cell.replace("|", "/")


def _cell(value: Any) -> str:
    """A number with three digits that count."""
    if isinstance(value, float):
        return f"{value:.0f}" if abs(value) >= 100.0 else f"{value:.3g}"
    return "" if value is None else str(value)


def rendered(page: str) -> str:
    """The text of a page with its tables as docs/figures has them."""
    return _PLACE.sub(lambda at: f"{at[1]}{markdown(read(at[2]))}\n{at[3]}", page)


def write_pages() -> None:
    """Write the tables of all pages anew."""
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        page.write_text(rendered(text), encoding="utf-8")


def _command() -> str:
    """What was called, without folders of this machine."""
    words = [Path(word).name if "/" in word else word for word in sys.argv[1:] if word != "--write"]
    return shlex.join(["python", "-m", f"benchmarks.{Path(sys.argv[0]).stem}", *words])


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
    write_pages()
