"""Checks of the times of a recording: clocks, order, gaps."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from graph_slam_ros.check.columns import Columns, OdometryColumns, TopicColumns
from graph_slam_ros.check.finding import Finding, Severity, Where
from graph_slam_ros.config.node import TimeConfig
from graph_slam_ros.formats.parameters import assignment
from graph_slam_ros.messages.receive_times import clock_offset_s
from graph_slam_ros.typing import Array, Index

_FEW, _MANY, _BACK_NS = 3, 10, 1_000_000_000
_CLOCKS_DIFFER_S, _EARLY_S, _DAY_S = 10.0, 0.15, 86400.0
_WINDOWS, _APART, _LEAST_S, _LEAST_MESSAGES = 20, 5, 30.0, 200
_DRIFT, _DRIFTED_S, _SCATTERS = 1e-4, 0.02, 4.0
_SAME_WAY = 0.85  # part of the slopes between windows that have one sign
_JUMP_S, _PER_WINDOW, _SIDE = 0.05, 5, 3
_DUPLICATES, _OUT_OF_ORDER = 0.01, 0.001
_LEAST_ROUNDED_NS, _AS_OTHERS, _COARSE_S = 1_000_000, 0.1, 0.15
_LONG_S, _VERY_LONG_S, _PERIODS, _MOVED_M, _TURNED = 1.0, 2.0, 10.0, 0.05, 0.05
_SLOW_HZ, _BETWEEN_S = 5.0, 0.02
_JITTER, _FAST_HZ = 1.5, 200.0
_SCATTERED_S, _REGULAR, _LEAST_STEPS = 0.05, 0.2, 50
_OUTSIDE, _NEARLY_ALL, _MARGIN_NS = 0.2, 0.95, 500_000_000


def check_times(c: Columns) -> Iterator[Finding]:
    """Clocks of inputs against the recorder's and each other, and the order of the stamps of each."""
    if constant := [one for topic in c.topics.values() for one in _constant(topic)]:
        yield from constant
        return
    for key, value in c.assumed.items():
        if key.endswith(".offset_s"):
            name = key.removesuffix(".offset_s")
            text = (
                f"{name}: its clock differs from that of odometry by {-float(value):.3f} s, by the times of recording"
            )
            topic = c.topic_of(name)
            where: Where = {"topic": "" if topic is None else topic.name, "settings": (assignment(key, value),)}
            yield Finding("clock_domains", "error", -value, _CLOCKS_DIFFER_S, "s", text, **where)
    stamped = {name: topic for name, topic in c.topics.items() if np.count_nonzero(topic.stamp_ns) >= _FEW}
    yield from _clocks(c, stamped)
    for topic in stamped.values():
        yield from _order(c, topic)
        yield from _scattered(topic)
    yield from _rate(c)
    yield from _overlap(c)


def _constant(topic: TopicColumns) -> Iterator[Finding]:
    """An input whose messages all have one stamp, though they were not recorded at one time."""
    stamp_ns = topic.stamp_ns[topic.stamp_ns != 0]
    is_input, count = topic.use in ("odometry", "landmarks"), len(stamp_ns)
    if is_input and count >= _MANY and not np.ptp(stamp_ns) and np.ptp(topic.log_ns):
        text = f"{topic.name}: all of its {count} messages have the stamp {stamp_ns[0] * 1e-9:.3f} s"
        at: Where = {"topic": topic.name, "first_ns": int(stamp_ns[0]), "count": count}
        yield Finding("constant_stamps", "error", count, _MANY, "messages", text, **at)


def rounded_s(o: OdometryColumns) -> float:
    """Return to how much the stamps of odometry are rounded, where several messages have one; 0 where they are not.

    Messages of one stamp then go on along the path as others do. A message that is there twice does not move, and that
    of another publisher is elsewhere.
    """
    stamp_ns, at = o.stamp_ns[o.stamp_ns != 0], o.poses[o.stamp_ns != 0, :3]
    own_ns = np.diff(np.unique(stamp_ns))
    if len(own_ns) < _FEW or own_ns.min() < _LEAST_ROUNDED_NS:
        return 0.0
    steps = own_ns / own_ns.min()
    moved = np.diff(at, axis=0)
    way_m, is_repeated = np.linalg.norm(moved, axis=1), np.diff(stamp_ns) == 0
    straight_m = np.linalg.norm(moved[1:] + moved[:-1], axis=1).sum()
    goes_on = straight_m > 0.5 * (way_m[1:] + way_m[:-1]).sum()
    as_others = way_m[is_repeated].mean() > _AS_OTHERS * way_m[~is_repeated].mean() if is_repeated.any() else False
    is_rounded = np.abs(steps - np.round(steps)).max() < _AS_OTHERS and goes_on and as_others
    return float(own_ns.min()) * 1e-9 if is_rounded else 0.0


def _lags(topic: TopicColumns) -> tuple[Array, Index, Index]:
    """Recorded less stamped [s], and both, of the messages that have a stamp."""
    is_stamped = topic.stamp_ns != 0
    log_ns, stamp_ns = topic.log_ns[is_stamped], topic.stamp_ns[is_stamped]
    return (log_ns - stamp_ns) * 1e-9, log_ns, stamp_ns


def _clocks(c: Columns, topics: dict[str, TopicColumns]) -> Iterator[Finding]:
    of_odometry = topics.get(c.odometry.topic)
    if of_odometry is None or any((np.diff(t.stamp_ns[t.stamp_ns != 0]) < -_BACK_NS).any() for t in topics.values()):
        return
    odometry_lag_s, odometry_log_ns, _ = _lags(of_odometry)
    typical_s = float(np.median(odometry_lag_s))
    for topic in topics.values():
        lag_s, log_ns, stamp_ns = _lags(topic)
        apart_s = clock_offset_s(log_ns, lag_s, odometry_log_ns, odometry_lag_s)
        where: Where = {"topic": topic.name, "first_ns": int(stamp_ns[0]), "count": len(stamp_ns)}
        if abs(apart_s) > _CLOCKS_DIFFER_S:
            yield _other_clock(c, topic, of_odometry, apart_s, where)
        elif apart_s < -_EARLY_S:
            text = (
                f"{topic.name}: recorded {-apart_s * 1e3:.0f} ms before the time in its stamps, compared with "
                f"{c.odometry.topic}: its clock is ahead"
            )
            setting = _offset(c, topic, apart_s)
            yield Finding("latency", "warning", -apart_s, _EARLY_S, "s", text, settings=(setting,), **where)
        if topic.use in ("odometry", "landmarks") and abs(typical_s) < _DAY_S:  # else simulated time, or played again
            jump = list(_jump(topic, lag_s, stamp_ns))
            yield from jump or _drift(topic, lag_s, log_ns, stamp_ns)


def _other_clock(c: Columns, topic: TopicColumns, of_odometry: TopicColumns, apart_s: float, where: Where) -> Finding:
    """A clock that is not that of odometry. Where odometry's alone is not the receiver's, it is odometry's."""
    is_right = abs(float(np.median(_lags(topic)[0]))) < _CLOCKS_DIFFER_S / 2.0
    wrong, right = (of_odometry, topic) if is_right else (topic, of_odometry)
    by_s = apart_s if wrong is topic else -apart_s
    text = f"{wrong.name}: its stamps are {-by_s:.1f} s away from those of {right.name}: another clock"
    settings = (_offset(c, wrong, by_s),)
    return Finding("clock_domains", "error", -by_s, _CLOCKS_DIFFER_S, "s", text, settings=settings, **where)


def _jump(topic: TopicColumns, lag_s: Array, stamp_ns: Index) -> Iterator[Finding]:
    """A step of the shortest lags of windows, that stays: of the clock, or of what delays the messages."""
    count = min(_WINDOWS, len(lag_s) // _PER_WINDOW)
    if count < 2 * _APART:
        return
    parts = np.array_split(np.arange(len(lag_s)), count)
    least_s = np.array([lag_s[part].min() for part in parts])

    def spread_s(cut: int) -> float:
        sides = least_s[:cut], least_s[cut:]
        return max(float(np.quantile(np.abs(side - np.median(side)), 0.8)) for side in sides)

    cut = min(range(_SIDE, count - _SIDE + 1), key=spread_s)
    step_s = float(np.median(least_s[:cut]) - np.median(least_s[cut:]))
    if not max(_JUMP_S, _SCATTERS * spread_s(cut)) < abs(step_s) < _CLOCKS_DIFFER_S:
        return
    at = int(stamp_ns[parts[cut][0]])
    about = f"about {(at - int(stamp_ns[0])) * 1e-9:.0f} s after the first"
    text = (
        f"{topic.name}: from {about} its stamps are {step_s * 1e3:+.0f} ms off against the times of recording: "
        "its clock was set, or its messages came with another delay"
    )
    yield Finding("clock_jump", "note", step_s, _JUMP_S, "s", text, topic.name, at, len(stamp_ns))


def _offset(c: Columns, topic: TopicColumns, offset_s: float) -> str:
    name = topic.inputs[0]
    before_s = next(one.offset_s for one in c.config.sources if one.name == name)
    return assignment(f"{name}.offset_s", round(before_s + offset_s, 3))


def _drift(topic: TopicColumns, lag_s: Array, log_ns: Index, stamp_ns: Index) -> Iterator[Finding]:
    """Theil-Sen slope of the shortest lags of windows: what delays a message only adds to its lag."""
    span_s = float(log_ns[-1] - log_ns[0]) * 1e-9
    if len(log_ns) < _LEAST_MESSAGES or span_s < _LEAST_S:
        return
    least_s = np.array([one.min() for one in np.array_split(lag_s, _WINDOWS)])
    at_s = np.array([(one - log_ns[0]).mean() for one in np.array_split(log_ns, _WINDOWS)]) * 1e-9
    later, earlier = np.tril_indices(_WINDOWS, -_APART)
    between_s = at_s[later] - at_s[earlier]
    if not (between_s > 0.0).any():
        return
    slopes = (least_s[later] - least_s[earlier])[between_s > 0.0] / between_s[between_s > 0.0]
    slope = float(np.median(slopes))
    scatter_s = float(np.median(np.abs(least_s - np.median(least_s) - slope * (at_s - np.median(at_s)))))
    drifted_s = abs(slope) * span_s
    if float((slopes * slope > 0.0).mean()) < _SAME_WAY:  # stamps that scatter
        return
    if abs(slope) > _DRIFT and drifted_s > max(_DRIFTED_S, _SCATTERS * scatter_s) and drifted_s < _CLOCKS_DIFFER_S:
        text = (
            f"{topic.name}: its clock runs {-slope * 1e6:+.0f} ppm against the recorder's "
            f"({-slope * span_s * 1e3:+.0f} ms in {span_s:.0f} s)"
        )
        where: Where = {"topic": topic.name, "first_ns": int(stamp_ns[0]), "count": len(stamp_ns)}
        yield Finding("clock_drift", "warning", -slope * 1e6, _DRIFT * 1e6, "ppm", text, **where)


def _order(c: Columns, topic: TopicColumns) -> Iterator[Finding]:
    stamp_ns = topic.stamp_ns[topic.stamp_ns != 0]
    step_s = np.diff(stamp_ns) * 1e-9
    repeated, back = step_s == 0.0, step_s < 0.0
    where: Where = {"topic": topic.name}
    share = float(repeated.mean())
    if topic.name == c.odometry.topic and share > _DUPLICATES and (each_s := rounded_s(c.odometry)):
        is_coarse = each_s > _COARSE_S
        text = f"{topic.name}: stamps are rounded to {each_s:.3g} s: {share:.1%} are that of the message before"
        found = Finding("coarse_stamps", "error", each_s, _COARSE_S, "s", text, **where)
        yield found if is_coarse else replace(found, code="rounded_stamps", severity="note")
    elif topic.use == "odometry" and share > _DUPLICATES:
        text = (
            f"{topic.name}: {share:.1%} of the messages have the stamp of the one before: published or recorded twice"
        )
        at, count = int(stamp_ns[1:][repeated][0]), int(repeated.sum())
        yield Finding("duplicates", "warning", share, _DUPLICATES, "part", text, first_ns=at, count=count, **where)
    if not back.any():
        return
    most_s, at, count = -float(step_s.min()), int(stamp_ns[1:][back][0]), int(back.sum())
    more: Where = {"first_ns": at, "count": count, **where}
    window_s = c.config.ordering.window_s if topic.use == "odometry" else c.config.ordering.late_s
    if most_s > 1.0 and most_s > window_s:
        text = f"{topic.name}: stamps step back by up to {most_s:.2f} s: the clock was set, or two drives were joined"
        is_expected = c.config.time.on_jump != TimeConfig().on_jump
        severity: Severity = "note" if is_expected else "error"
        yield Finding("time_jump", severity, most_s, 1.0, "s", text, **more)
    elif topic.use == "odometry" and most_s > window_s and count > _OUT_OF_ORDER * len(step_s):
        text = f"{topic.name}: {count} messages are older than the one before, by up to {most_s * 1e3:.0f} ms"
        setting = assignment("ordering.window_s", round(1.2 * most_s + 0.005, 3))
        yield Finding("out_of_order", "warning", most_s, window_s, "s", text, settings=(setting,), **more)


def _rate(c: Columns) -> Iterator[Finding]:
    o = c.odometry
    stamp_ns, order = np.unique(o.stamp_ns[o.stamp_ns != 0], return_index=True)
    if len(stamp_ns) < _FEW:
        return
    poses = o.poses[o.stamp_ns != 0][order]
    step_s = np.diff(stamp_ns) * 1e-9
    median_s = float(np.median(step_s))
    where: Where = {"topic": o.topic, "first_ns": int(stamp_ns[0]), "count": len(stamp_ns)}
    most_s = max(_PERIODS * median_s, _LONG_S)
    long = np.flatnonzero(step_s > most_s)
    if len(long):
        moved = np.linalg.norm(np.diff(poses[:, :3], axis=0)[long], axis=1) > _MOVED_M
        turned = np.linalg.norm(np.diff(poses[:, 3:], axis=0)[long], axis=1) > _TURNED
        worst_s = float(step_s[long].max())
        is_bad = bool((step_s[long][moved | turned] > max(_PERIODS * median_s, _VERY_LONG_S)).any())
        text = (
            f"{o.topic} comes at {1.0 / median_s:.0f} Hz, but is silent for more than {most_s:.1f} s "
            f"{_often(len(long))} (the longest {worst_s:.2f} s{'; the robot moved meanwhile' if is_bad else ''})"
        )
        at: Where = {"topic": o.topic, "first_ns": int(stamp_ns[long[0]]), "count": len(long)}
        yield Finding("gap", "warning" if is_bad else "note", worst_s, most_s, "s", text, **at)
    if 1.0 / median_s < _SLOW_HZ:
        between = _between(c, stamp_ns)
        text = f"{o.topic} comes at {1.0 / median_s:.1f} Hz: poses are interpolated over {median_s:.2f} s"
        severity: Severity = "warning" if between > 0.5 else "note"
        yield Finding("slow_odometry", severity, 1.0 / median_s, _SLOW_HZ, "Hz", text, **where)
    spread = float(np.subtract(*np.percentile(step_s, [90.0, 10.0]))) / median_s
    if spread > _JITTER and 1.0 / median_s < _FAST_HZ:
        text = f"{o.topic}: the times between stamps vary by {spread:.1f} times their median: stamped on arrival?"
        yield Finding("jitter", "note", spread, _JITTER, "times", text, **where)


def _scattered(topic: TopicColumns) -> Iterator[Finding]:
    """Sightings that are recorded at regular times and stamped at others: each stamp is wrong by an error of its own.

    Messages that are late on their way are not: those are recorded at irregular times.
    """
    stamped = topic.stamp_ns != 0
    if topic.use != "landmarks" or np.count_nonzero(stamped) <= _LEAST_STEPS:
        return
    recorded_s, step_s = (np.diff(of[stamped]) * 1e-9 for of in (topic.log_ns, topic.stamp_ns))
    every_s, median_s = float(np.median(recorded_s)), float(np.median(step_s))
    vary_s, regular_s = (float(np.subtract(*np.percentile(of, [90.0, 10.0]))) for of in (step_s, recorded_s))
    is_regular = abs(median_s - every_s) < _REGULAR * every_s and regular_s < _REGULAR * vary_s
    if vary_s > _SCATTERED_S and is_regular:
        text = (
            f"{topic.name}: a message is recorded each {every_s:.2f} s, and the times between stamps vary by "
            f"{vary_s:.2f} s: each stamp is wrong by an error of its own"
        )
        at: Where = {"topic": topic.name, "first_ns": int(topic.stamp_ns[stamped][0]), "count": len(step_s) + 1}
        yield Finding("jitter", "warning", vary_s, _SCATTERED_S, "s", text, **at)


def _often(times: int) -> str:
    return {1: "once", 2: "twice"}.get(times, f"{times} times")


def _between(c: Columns, odometry_ns: Index) -> float:
    """The part of the sightings that are far from any stamp of odometry."""
    stamps_ns = np.concatenate([s.stamp_ns for s in c.sightings]) if c.sightings else np.empty(0, dtype=np.int64)
    if not len(stamps_ns):
        return 0.0
    after = np.clip(np.searchsorted(odometry_ns, stamps_ns), 1, len(odometry_ns) - 1)
    away_ns = np.minimum(np.abs(stamps_ns - odometry_ns[after - 1]), np.abs(stamps_ns - odometry_ns[after]))
    return float((away_ns > _BETWEEN_S * 1e9).mean())


def _overlap(c: Columns) -> Iterator[Finding]:
    if not len(c.path_ns):
        return
    first_ns, last_ns = int(c.path_ns.min()), int(c.path_ns.max())
    for s in c.sightings:
        outside = (s.stamp_ns < first_ns - _MARGIN_NS) | (s.stamp_ns > last_ns + _MARGIN_NS)
        share = float(outside.mean()) if len(outside) else 0.0
        if share <= _OUTSIDE:
            continue
        at: Where = {"topic": s.topic, "first_ns": int(s.stamp_ns[outside][0]), "count": int(outside.sum())}
        ends = [(int(t) - first_ns) * 1e-9 for t in (s.stamp_ns.min(), s.stamp_ns.max())]
        if share < _NEARLY_ALL and _recorded_alone(c, s.topic) > _OUTSIDE:
            after_s = ends[1] - (last_ns - first_ns) * 1e-9
            when = [f"begins {-ends[0]:.1f} s after the first of them"] * (-ends[0] > _MARGIN_NS * 1e-9)
            when += [f"ends {after_s:.1f} s before the last of them"] * (after_s > _MARGIN_NS * 1e-9)
            text = f"{s.topic}: {share:.0%} of the sightings were recorded without odometry, which {' and '.join(when)}"
            yield Finding("odometry_short", "warning", share, _OUTSIDE, "part", text, **at)
            continue
        text = (
            f"{s.topic}: {share:.0%} of the sightings are stamped outside the time of odometry ({ends[0]:.1f} "
            f"to {ends[1]:.1f} s, odometry 0 to {(last_ns - first_ns) * 1e-9:.1f} s)"
        )
        yield Finding("no_overlap", "error", share, _OUTSIDE, "part", text, **at)


def _recorded_alone(c: Columns, name: str) -> float:
    """Return which part of the messages of a topic was recorded before odometry or after it, whatever their stamps."""
    topic, of_odometry = c.topics.get(name), c.topics.get(c.odometry.topic)
    if topic is None or of_odometry is None or not len(topic.log_ns) or not len(of_odometry.log_ns):
        return 0.0
    first_ns, last_ns = of_odometry.log_ns.min() - _MARGIN_NS, of_odometry.log_ns.max() + _MARGIN_NS
    return float(((topic.log_ns < first_ns) | (topic.log_ns > last_ns)).mean())
