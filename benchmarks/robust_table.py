"""The table of docs/robustness.md, and below it the cells that miss their target."""

from collections.abc import Iterator, Sequence
from statistics import median
from typing import Any

from benchmarks.contenders import OURS
from benchmarks.robust_cells import CLEAN_CHI2, CLEAN_LOST, CLEAN_TIME
from benchmarks.trials import ID_POLICIES

Row = dict[str, Any]

NAMES = (
    "graph",
    "odometry, m",
    "false ones",
    "who",
    "error, m",
    "chi2",
    "believed",
    "fully",
    "true lost",
    "CPU s",
    "of plain",
    "asked",
)


def lines(rows: Sequence[Row]) -> Iterator[list[str]]:
    """Medians over the seeds, and in brackets the worst; graph and cell are named in the first of their lines."""
    before: Row = {}
    for row in rows:
        same_graph = before.get("graph") == row["graph"]
        same_cell = same_graph and all(before[key] == row[key] for key in ("policy", "rate"))
        graph = ["", ""] if same_graph else [row["graph"], f"{row['odometry_m']:.2f}"]
        cell = "" if same_cell else f"{row['policy']}, {row['false']} of {row['false'] + row['true']}"
        counts = [_spread(row[key], "g") for key in ("believed", "full", "lost")]
        times = [time for time, fault in zip(row["cpu_s"], row["fault"], strict=True) if not fault]
        plain = f"{median(times) / row['plain_s']:.1f}" if times and row["plain_s"] else ""
        time = f"{median(times):.2f}" if times else ""
        error = " ".join(filter(None, (_spread(row["error_m"], ".4f"), _failed(row))))
        verdict = "" if row["who"] != OURS else ", ".join(misses(row)) or "met" if _is_asked(row) else ""
        yield [*graph, cell, name(row), error, _spread(row["chi2"], ".3f"), *counts, time, plain, verdict]
        before = row


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


def _is_asked(row: Row) -> bool:
    return row["target"] is not None or not row["false"]


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
