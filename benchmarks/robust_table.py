"""The table of docs/robustness.md, and below it the cells that miss their target."""

from collections.abc import Iterator, Sequence
from statistics import median
from typing import Any

from benchmarks.contenders import OURS
from benchmarks.robust_cells import CLEAN_CHI2, CLEAN_LOST, CLEAN_TIME
from benchmarks.trials import ID_POLICIES

Row = dict[str, Any]

_OURS = ("ours, online", "ours, solved")


def table(rows: Sequence[Row]) -> tuple[list[str], list[list[str]]]:
    """Names of columns, and a line for each cell: errors of ours online and of peers, and the time of ours, solved.

    Errors are medians over the seeds, and in brackets the worst.
    """
    peers = [who for who in dict.fromkeys(str(row["who"]) for row in rows) if who != OURS]
    cells: dict[tuple[Any, ...], dict[str, Row]] = {}
    for row in rows:
        cells.setdefault((row["graph"], row["policy"], row["rate"]), {})[name(row)] = row
    lines, graph = [], ""
    for key, by in cells.items():
        row = next(iter(by.values()))
        start = [str(key[0]) * (key[0] != graph), f"{key[1]}, {row['false']} of {row['false'] + row['true']}"]
        errors = [_error(by.get(who)) for who in (*_OURS, *peers)]
        lines.append([*start, *errors[:2], _of_plain(by.get(_OURS[1])), *errors[2:]])
        graph = key[0]
    return ["graph", "false ones", *_OURS, "of plain", *peers], lines


def _error(row: Row | None) -> str:
    """The error in metres, and how many seeds have none and why."""
    return "" if row is None else " ".join(filter(None, (_spread(row["error_m"], ".4f"), _failed(row))))


def _of_plain(row: Row | None) -> str:
    """CPU time over that without a loss and without false measurements."""
    times = [time for time, fault in zip(row["cpu_s"], row["fault"], strict=True) if not fault] if row else []
    return f"{median(times) / row['plain_s']:.1f}" if row and times and row["plain_s"] else ""


def missed(rows: Sequence[Row]) -> str:
    """The cells of ours that miss what is asked, with their seeds."""
    found = [
        f"* {row['graph']}, {row['policy']} {100.0 * row['rate']:g} %, {name(row)}: {', '.join(misses(row))}"
        for row in rows
        if row["who"] == OURS and misses(row)
    ]
    return "\n".join(found) or "* none"


def name(row: Row) -> str:
    """Who, and when: after the last measurement came, or after everything was solved."""
    return f"ours, {'online' if row['stage'] == 'online' else 'solved'}" if row["who"] == OURS else str(row["who"])


def misses(row: Row) -> list[str]:
    """What of that which is asked of a row it misses."""
    out = []
    if row["target"] is not None:
        most = row["target"]["error_m"]
        far = [seed for seed, error in zip(row["seeds"], row["error_m"], strict=True) if error is None or error > most]
        if len(far) > (1.0 - row["target"]["seeds"]) * len(row["seeds"]) + 1e-9:
            out.append(f"over {most:.3g} m: {_seeds(far)}")
        full = [seed for seed, count in zip(row["seeds"], row["full"], strict=True) if count]
        if full and row["policy"] not in ID_POLICIES:
            out.append(f"false ones count fully: {_seeds(full)}")
    if not row["false"]:
        out += _misses_without_false(row)
    return out


def _misses_without_false(row: Row) -> Iterator[str]:
    (cost,), (lost,), (time,) = row["chi2"], row["lost"], row["cpu_s"]
    if cost is not None and row["plain_chi2"] is not None and cost > CLEAN_CHI2 * row["plain_chi2"]:
        yield f"chi2 is {cost / row['plain_chi2']:.4f} of plain"
    if lost is not None and lost > CLEAN_LOST[row["stage"]] * row["true"]:
        yield f"{lost} true ones lost"
    if time > CLEAN_TIME * row["plain_s"]:
        yield f"{time / row['plain_s']:.2f} of the plain time"


def _seeds(seeds: Sequence[int]) -> str:
    return f"seed{'s' if len(seeds) > 1 else ''} {', '.join(map(str, seeds))}"


def _failed(row: Row) -> str:
    """How many seeds have no path, and why the first of them has none."""
    faults = [fault for fault in row["fault"] if fault]
    of = f"{len(faults)} of {len(row['fault'])} " if len(faults) < len(row["fault"]) else ""
    return f"{of}{faults[0]}".replace("|", "/") if faults else ""


def _spread(values: Sequence[float | None], form: str) -> str:
    """Median, and in brackets the worst where there are several."""
    known = [value for value in values if value is not None]
    if not known:
        return ""
    middle, worst = (format(value, form) for value in (median(known), max(known)))
    return middle if middle == worst else f"{middle} ({worst})"
