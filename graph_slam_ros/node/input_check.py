"""The check of the inputs while the robot drives: their units, axes, clocks, and the twist and rate of odometry.

It is that of a replay (``check.checks.worst_while_driving``), again and again, of the last minutes.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

from graph_slam_ros.check.checks import worst_while_driving
from graph_slam_ros.check.columns import Collector, Columns
from graph_slam_ros.findings.finding import Finding
from graph_slam_ros.findings.table import DOUBTS
from graph_slam_ros.measurements.counters import Counters
from graph_slam_ros.measurements.types import Measured, Odometry
from graph_slam_ros.messages.from_msg import TF, TF_STATIC
from graph_slam_ros.messages.inputs import uses
from graph_slam_ros.slam import Config

_APART_NS = 50_000_000  # of stamps of odometry that are collected
_APART_S = 0.045  # of messages of odometry that are collected
_MOST_POSES, _MOST_SIGHTINGS = 3_000, 20_000  # that are checked at once: minutes
_LEAST = 30  # poses, sightings or pairs of a finding
_FEW = {"clock_domains": 5}  # messages
_FEW_LEFT_OUT = 10  # one of so many messages
_PERIOD_S, _SOON_S, _SPARE = 3.0, 0.5, 50.0  # between two checks; of the time, one part


class InputCheck:
    """Collects what is measured, and checks it in threads, one after the other. ``findings`` is what is wrong now."""

    def __init__(self, config: Config, topics: Mapping[str, str], counters: Counters) -> None:
        self._collector = Collector(config, {**topics, TF_STATIC: "/tf_static"})
        self._counters = counters
        used = uses(config)
        checked = [one for one in config.sources if used.get(one.name) in ("landmarks", "odometry")]
        types = {one.type for one in checked}
        self._read = {TF, TF_STATIC} | {one.name for one in config.sources if one.type in types}
        self._odometry = {topics[one.name] for one in checked if used[one.name] == "odometry"}
        self._last_ns: dict[str, int] = {}
        self._last_s: dict[str, float] = {}
        self._messages = 0  # since the last check
        self._kept = self._left_out = 0  # messages of odometry in this collection, and between them
        self._due_s, self._goes_on = 0.0, False
        self.findings: tuple[Finding, ...] = ()

    def add(
        self, topic: str, names: Sequence[str], now_ns: int, measured: Sequence[Measured], message: Any = None
    ) -> None:
        """Collect a decoded message of these inputs, and what it has measured; of odometry, a part is enough."""
        is_held = len(measured) > 1  # until now: its messages are collected already
        some = [m for m in measured if not isinstance(m, Odometry) or self._is_next(m) or is_held]
        if topic in self._odometry:
            now_s = time.monotonic()
            is_due = now_s - self._last_s.get(topic, 0.0) >= _APART_S  # some of each second are enough
            if (some or not measured) and is_due:  # what was used is collected as it was used, too
                self._last_s[topic] = now_s
                self._kept += 1
            else:
                message = None
                self._left_out += 1
        self._messages += 1
        message = None if self._read.isdisjoint(names) else message
        self._collector.add(topic, [name for name in names if name != TF], now_ns, some, message)

    def forget(self) -> None:
        """Begin anew, with other stamps."""
        self._collector.begin_anew()
        self._last_ns.clear()
        self._kept = self._left_out = 0

    def job(self) -> Callable[[], None] | None:
        """Return the next check, for a thread; None if none is due, or the last goes on."""
        if self._goes_on or time.monotonic() < self._due_s or self._messages < _LEAST:
            return None
        self._goes_on, self._messages = True, 0
        self._due_s = time.monotonic() + _PERIOD_S
        columns = self._collector.columns(self._counters)
        sightings = sum(len(one.stamp_ns) for one in columns.sightings)
        poses = max(len(columns.path_ns), len(columns.odometry.stamp_ns))
        is_thinned = self._left_out * _FEW_LEFT_OUT > self._kept
        is_full = poses >= _MOST_POSES or sightings >= _MOST_SIGHTINGS
        if is_full:
            self.forget()
        return partial(self._check, columns, is_full=is_full, is_thinned=is_thinned)

    def _is_next(self, m: Odometry) -> bool:
        """Return whether odometry is collected. What comes late is not: nor is it used."""
        if m.stamp_ns - self._last_ns.get(m.source, 0) < _APART_NS:
            return False
        self._last_ns[m.source] = m.stamp_ns
        return True

    def _check(self, columns: Columns, *, is_full: bool, is_thinned: bool) -> None:
        """Replace the findings. That nothing is wrong is believed of a full collection only.

        Messages that come in bursts are thinned, so what is collected does not say how often they are sent.
        """
        begun = time.thread_time()  # a busy machine takes its time, and is no reason to look seldom
        try:
            found = [one for one in worst_while_driving(columns) if one.code != "slow_odometry" or not is_thinned]
            if sure := [one for one in found if one.count >= _FEW.get(one.code, _LEAST)]:
                self.findings = tuple(map(_as_cause, sure))
            elif found:
                self._due_s = time.monotonic() + _SOON_S
            elif is_full:
                self.findings = ()
        finally:
            self._due_s += _SPARE * (time.thread_time() - begun)
            self._goes_on = False


def _as_cause(found: Finding) -> Finding:
    """A finding of which all that may follow is not said."""
    return replace(found, severity="error", text=f"{found.code}: {found.text}", follows=(*DOUBTS, "confused"))
