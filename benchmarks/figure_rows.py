"""Rows of figures, the committed table of them, and the comparison: what is worse, gone, or not measured."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields

from benchmarks import table

TABLE = "figures"
RESULT, TIME, COST = 1.02, 1.3, 1.001
"""Tolerances: of results, of CPU times, which vary by a fifth from run to run, and of chi2."""
NEVER = float("inf")
_NUMBERS = ("value", "tolerance", "slack")


@dataclass(frozen=True, slots=True)
class Row:
    """One figure.

    Attributes
    ----------
    better : lower, higher, or the number that is right
    tolerance, slack : worse is what is worse than the committed value by this factor, and by that much
    """

    name: str
    value: float
    unit: str = ""
    better: str = "lower"
    tolerance: float = RESULT
    slack: float = 0.0
    comment: str = ""

    def is_worse(self, than: float) -> bool:
        """Return whether this is worse than a committed value allows."""
        if self.better == "higher":
            return not self.value * self.tolerance + self.slack >= than
        if self.better == "lower":
            return not self.value <= than * self.tolerance + self.slack
        right = float(self.better)
        off, allowed = (max(one / right, right / one) if one > 0.0 else NEVER for one in (self.value, than))
        return not off <= allowed * self.tolerance


@dataclass(frozen=True, slots=True)
class Outcome:
    """Rows, or why there are none."""

    rows: tuple[Row, ...] = ()
    absent: str = ""
    failed: str = ""
    cpu_s: float = 0.0


def read_table() -> dict[str, Row]:
    """Return the committed rows, by name."""
    rows = [{k: float(v) if k in _NUMBERS else v for k, v in row.items()} for row in table.read(TABLE)]
    return {str(row["name"]): Row(**row) for row in rows}  # type: ignore[arg-type]


def write_table(rows: Iterable[Row]) -> None:
    """Replace the table."""
    table.store(TABLE, [{one.name: _text(getattr(row, one.name)) for one in fields(Row)} for row in rows])


def _text(value: float | str) -> str:
    return value if isinstance(value, str) else f"{value:.5g}"


def compare(outcomes: Mapping[str, Outcome], committed: Mapping[str, Row]) -> list[str]:
    """Print the table; return what is worse, has failed, or no longer exists."""
    rows, worse = [row for one in outcomes.values() for row in one.rows], list[str]()
    print(f"\n{'':53s}{'committed':>11s}{'now':>11s}  {'unit':9s}{'better':8s}{'allowed'}")
    for row in rows:
        old = committed.get(row.name)
        told, mark = ("", "  new") if old is None else (_text(old.value), "")
        if old is not None and row.is_worse(old.value):
            mark = "  WORSE"
            worse.append(f"worse: {row.name}: {told} -> {_text(row.value)} {row.unit}")
        print(f"{row.name:53s}{told:>11s}{_text(row.value):>11s}  {row.unit:9s}{row.better:8s}x{row.tolerance:g}{mark}")
    failed = [f"failed: {name}: {one.failed}" for name, one in outcomes.items() if one.failed]
    without = tuple(f"{name}: " for name, one in outcomes.items() if one.absent or one.failed)
    there = {row.name for row in rows}
    gone = [f"gone: {name}" for name in committed if name not in there and not name.startswith(without)]
    for name, one in outcomes.items():
        if one.absent:
            print(f"left out: {name}: because there is {one.absent}")
    return worse + failed + gone
