"""Compares two fleets recording by recording, with an interval that tells progress from chance."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.tools.fleet.store import read_table

METRICS = ("rmse_m", "rpe_m_per_m", "angle_rad", "map_rmse_m", "nees", "cpu_s", "memory_mib")
_SHORT = {"rmse": "rmse_m", "rpe": "rpe_m_per_m", "angle": "angle_rad", "map_rmse": "map_rmse_m", "cpu": "cpu_s"}
_LIMIT = re.compile(r"\s*([a-z_0-9.]+)\s*>\s*([0-9.]+(?:e-?[0-9]+)?)(x?)\s*")
EXCEEDED, LOST, GAINED = "Exceeded", "Failed now, and not before", "Done now, and not before"
ONLY_NEW = "Only in the new table"
_LEVEL, _SEED, _RESAMPLES = 0.95, 0, 2000


@dataclass(frozen=True, slots=True)
class Change:
    """The change of a metric over the recordings that both fleets have.

    Attributes
    ----------
    metric : column of the table
    count : recordings with the metric in both
    old, new : means
    ratio : geometric mean of new / old
    interval : 95 % of it, by bootstrap over recordings; equal ends with one recording
    worst : recording and ratio that grew most
    """

    metric: str
    count: int
    old: float
    new: float
    ratio: float
    interval: tuple[float, float]
    worst: tuple[str, float]

    @property
    def verdict(self) -> str:
        """``better``, ``worse``, or ``same``, as the interval is below, above or around 1."""
        low, high = self.interval
        return "better" if high < 1.0 else "worse" if low > 1.0 else "same"


@dataclass(frozen=True, slots=True)
class Limit:
    """A limit of a metric; ``relative``: of the ratio new / old, else of the mean."""

    metric: str
    value: float
    relative: bool
    text: str


@dataclass(frozen=True, slots=True)
class Comparison:
    """Two fleets compared: the change of each metric that both have, and by their titles the recordings and limits."""

    changes: list[Change]
    notes: dict[str, list[str]]


def parse_limit(text: str) -> Limit:
    """Return the limit of ``rmse>1.02x`` (ratio) or ``rmse_m>0.3`` (mean).

    Raises GraphSlamError: it is not such a limit.
    """
    found = _LIMIT.fullmatch(text)
    if found is None:
        raise GraphSlamError(f"--fail {text}: is not METRIC>NUMBER or METRIC>NUMBERx, as rmse>1.02x")
    metric = _SHORT.get(found[1], found[1])
    return Limit(metric, float(found[2]), bool(found[3]), text.strip())


def compare(old: Path, new: Path, limits: Sequence[Limit] = ()) -> Comparison:
    """Compare the tables of two fleets.

    Raises GraphSlamError: a folder without a table, nothing in common, or a limit on a metric that no row has.
    """
    before, after = _by_pair(old, new)
    common = sorted(before.keys() & after.keys())
    if not common:
        raise GraphSlamError(f"{old} and {new}: no recording and setting in common")
    both = [k for k in common if _ok(before[k]) and _ok(after[k])]
    metrics = dict.fromkeys((*METRICS, *(one.metric for one in limits)))
    changes = [change for metric in metrics if (change := _change_of(metric, both, before, after))]
    notes = {
        EXCEEDED: _exceeded(limits, {one.metric: one for one in changes}),
        LOST: [f"{_name(k)}: {after[k]['reason']}" for k in common if _ok(before[k]) and not _ok(after[k])],
        GAINED: [_name(k) for k in common if not _ok(before[k]) and _ok(after[k])],
        "Only in the old table": [_name(k) for k in sorted(before.keys() - after.keys())],
        ONLY_NEW: [_name(k) for k in sorted(after.keys() - before.keys())],
    }
    return Comparison(changes, notes)


Key = tuple[str, str]


def _by_pair(old: Path, new: Path) -> tuple[dict[Key, dict[str, Any]], dict[Key, dict[str, Any]]]:
    """The rows of both by recording and setting. The setting is left out where each has a single one."""
    tables = [read_table(folder) for folder in (old, new)]
    single = all(len({row["setting"] for row in rows}) == 1 for rows in tables)
    before, after = ({(row["recording"], "" if single else row["setting"]): row for row in rows} for rows in tables)
    return before, after


def _ok(row: Mapping[str, Any]) -> bool:
    return row["state"] != "failed"


def _name(key: Key) -> str:
    return " ".join(part for part in key if part)


def _change_of(metric: str, keys: Sequence[Key], before: Mapping[Key, Any], after: Mapping[Key, Any]) -> Change | None:
    """The change of a metric over recordings and settings; None if none has it in both, above 0."""
    pairs = [(k, before[k].get(metric), after[k].get(metric)) for k in keys]
    pairs = [(k, float(a), float(b)) for k, a, b in pairs if a is not None and b is not None and a > 0.0 and b > 0.0]
    if not pairs:
        return None
    ratios = np.array([b / a for _, a, b in pairs])
    worst = int(np.argmax(ratios))
    return Change(
        metric,
        len(pairs),
        float(np.mean([a for _, a, _ in pairs])),
        float(np.mean([b for _, _, b in pairs])),
        float(np.exp(np.log(ratios).mean())),
        _interval(ratios),
        (_name(pairs[worst][0]), float(ratios[worst])),
    )


def _interval(ratios: np.ndarray[Any, Any]) -> tuple[float, float]:
    """The interval of the geometric mean over recordings drawn anew (percentile bootstrap)."""
    logs = np.log(ratios)
    if len(logs) == 1 or np.ptp(logs) == 0.0:
        return float(ratios[0]), float(ratios[0])
    drawn = np.random.default_rng(_SEED).integers(0, len(logs), (_RESAMPLES, len(logs)))
    low, high = np.quantile(logs[drawn].mean(axis=1), (0.5 - 0.5 * _LEVEL, 0.5 + 0.5 * _LEVEL))
    return float(np.exp(low)), float(np.exp(high))


def _exceeded(limits: Sequence[Limit], changes: Mapping[str, Change]) -> list[str]:
    out = []
    for limit in limits:
        change = changes.get(limit.metric)
        if change is None:
            raise GraphSlamError(
                f"--fail {limit.text}: no recording has {limit.metric} in both tables: --truth gives errors"
            )
        low, high = change.interval
        if limit.relative and change.ratio > limit.value and low > 1.0:
            out.append(f"{limit.text}: {change.ratio:.3f}x ({low:.3f} to {high:.3f}) over {change.count} recordings")
        elif not limit.relative and change.new > limit.value:
            out.append(f"{limit.text}: {change.new:.4g} over {change.count} recordings")
    return out


def markdown(done: Comparison) -> str:
    """Return the comparison as Markdown, for a pull request."""
    lines = [
        "| metric | recordings | old | new | ratio (95 %) | verdict | grew most |",
        "|---|---|---|---|---|---|---|",
    ]
    for one in done.changes:
        low, high = one.interval
        lines.append(
            f"| {one.metric} | {one.count} | {one.old:.4g} | {one.new:.4g} | {one.ratio:.3f} ({low:.3f} to {high:.3f}) "
            f"| {one.verdict} | {_cell(one.worst[0])} {one.worst[1]:.2f}x |"
        )
    for title, names in done.notes.items():
        if names:
            lines += ["", f"**{title}**", "", *(f"* {_cell(name)}" for name in names)]
    return "\n".join(lines) + "\n"


def _cell(text: str) -> str:
    """A text that Markdown shows as it is."""
    return re.sub(r"([\\`*_{}\[\]<>|#])", r"\\\1", " ".join(text.split()))
