"""Checks of the times of a recording: clocks, order, gaps."""

from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np

from graph_slam_ros.check.columns import MOST, Columns, OdometryColumns, TopicColumns
from graph_slam_ros.config.node import TimeConfig
from graph_slam_ros.findings.finding import Finding, Severity
from graph_slam_ros.formats.parameters import assignment
from graph_slam_ros.messages.receive_times import clock_offset_s
from graph_slam_ros.typing import Array, Index, Mask

# In brackets: by how much less and more the findings of 179 recordings are the same, faults and robots among them.
_FEW, _MANY = 3, 10  # messages whose stamps (0, x 4), and whose pace is judged (0, x 4)
_CLOCKS_DIFFER_S, _SET_S, EARLY_S = 10.0, 1.0, 0.15  # (x 0.3, any), (x 0.5, x 4), (x 0.7, x 1): a recorder's own delay
MOST_LATE_S = 1.0  # of a clock that is looked for: more is seen by the times of recording
_DUPLICATES, _OUT_OF_ORDER = 0.01, 0.001  # part of the messages (x 0.03, x 30), (0, x 4)
_LEAST_ROUNDED_NS, _AS_OTHERS, _COARSE_S = 1_000_000, 0.1, 0.15  # stamps with a finer grid, or in which it stands still
_LONG_S = 1.0  # of a gap (x 1, x 1), twice that where the robot moves (x 0.7, x 2)
_PERIODS = 10.0  # of odometry (0, x 2)
_MOVED = 0.05  # m, or of a quaternion's numbers (0, x 30)
_SLOW_HZ, _BETWEEN_S = 5.0, 0.02  # (x 0.5, x 2), of a sighting from the nearest pose (0, x 4)
_CROWDED, _FASTER = 0.2, 1.5  # of a second, and of the pace (x 0.03, x 4), pace by the usual one (x 0.7, x 30)
_STANDS = 1e-4  # s/s: no simulated time is so slow (0, x 30)
_OF_A_SECOND = {1: "zeros", 1_000: "milliseconds", 1_000_000: "microseconds"}
_PACE, _GOES_ON, _STEPS = 0.05, 0.3, 5  # m/s (0, x 4), of it in a gap (x 0.3, x 2), steps beside it (1, any)
_OUTSIDE, _NEARLY_ALL = 0.2, 0.95  # part of the sightings (x 0.3, x 2), (x 0.03, x 1)
_MARGIN_NS = 500_000_000  # before and after odometry, which is extrapolated there (0, x 30)


def check_times(c: Columns) -> Iterator[Finding]:
    """Clocks of inputs against the recorder's and each other, and the order of the stamps of each."""
    right = [topic for topic in c.topics.values() if not c.counters[topic.inputs[0], "bad_stamp"]]
    stamped = {topic.topic: topic.some(topic.stamp_ns != 0) for topic in right}
    if wrong := list(_wrong(stamped)):
        yield from wrong
        return
    for key, value in c.assumed.items():
        if key.endswith(".offset_s"):
            name, apart = key.removesuffix(".offset_s"), f"{-float(value):.3f} s, by the times of recording"
            text, topic = f"{name}: its clock differs from that of odometry by {apart}", c.topic_of(name)
            of, settings = "" if topic is None else topic.topic, (assignment(key, value),)
            yield Finding("clock_domains", "error", -value, _CLOCKS_DIFFER_S, "s", text, of, settings=settings)
    stamped = {name: topic for name, topic in stamped.items() if len(topic.stamp_ns) >= _FEW}
    yield from _clocks(c, stamped)
    for topic in stamped.values():
        yield from _order(c, topic)
    yield from _rate(c)
    yield from _overlap(c)


def _wrong(topics: Mapping[str, TopicColumns]) -> Iterator[Finding]:
    """Inputs whose stamps are all one, crowd together in each second, or advance much faster or slower than others'."""
    advance = dict[str, float]()
    for name, topic in topics.items():
        log_ns, stamp_ns = topic.log_ns, topic.stamp_ns
        if len(log_ns) < _MANY or not np.ptp(log_ns):
            continue
        if not np.ptp(stamp_ns):
            text = f"all of its {len(stamp_ns)} messages have the stamp {stamp_ns[0] * 1e-9:.3f} s"
            yield topic.finding("constant_stamps", "error", len(stamp_ns), _MANY, "messages", text)
            continue
        apart = max(1, len(log_ns) // 4)
        span_ns = np.maximum(log_ns[apart:] - log_ns[:-apart], 1)
        advance[name] = float(np.median((stamp_ns[apart:] - stamp_ns[:-apart]) / span_ns))
        crowded = np.median(np.diff(stamp_ns)) < _CROWDED * np.median(np.diff(log_ns)) and advance[name] > _CROWDED
        part = int(np.quantile(stamp_ns % 10**9, _NEARLY_ALL))
        if part < _CROWDED * 1e9 and crowded and (part or topic.use != "odometry"):  # whose rounding is told apart
            unit = next((unit for most, unit in _OF_A_SECOND.items() if part < most), "ticks")
            text = f"all that comes in a second is stamped within {part * 1e-6:.3g} ms: nanosec has {unit}"
            yield topic.finding("wrong_stamps", "error", part * 1e-9, _CROWDED, "s", text)
            return
    usual = float(np.median(list(advance.values()))) if len(advance) > 2 else 1.0  # simulated time may be slow
    for name, rate in advance.items():
        others = [other for other in advance.values() if other != rate]
        if rate < _STANDS or (_differ(rate, usual) and any(_differ(rate, other) for other in others)):
            text = f"its stamps advance by {rate:.3g} s for each second in which its messages were recorded"
            yield topics[name].finding("wrong_stamps", "error", rate, _FASTER, "s/s", text)


def _differ(a: float, b: float) -> bool:
    return b > 0.0 and not b / _FASTER < a < b * _FASTER


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


def _clocks(c: Columns, topics: dict[str, TopicColumns]) -> Iterator[Finding]:
    of_odometry = topics.get(c.odometry.topic)
    if of_odometry is None:
        return
    is_set_back = any((np.diff(t.stamp_ns) < -_SET_S * 1e9).any() for t in topics.values())
    own = of_odometry.log_ns, of_odometry.lag_s
    for topic in topics.values():
        log_ns, lag_s = topic.log_ns, topic.lag_s
        apart_s = 0.0 if is_set_back else clock_offset_s(log_ns, lag_s, *own)
        few = max(1, len(lag_s) // 5)
        parts = ((log_ns[k], lag_s[k]) for k in (slice(few), slice(-few, None)))
        first_s, last_s = (clock_offset_s(*part, *own) for part in parts)
        if abs(set_s := last_s - first_s) > _SET_S:
            is_own = abs(np.median(lag_s[-few:]) - np.median(lag_s[:few])) > 0.5 * abs(set_s)
            text = f"by the times of recording, its clock was set on the way by {abs(set_s):.1f} s"
            of = topic if is_own else of_odometry
            yield of.finding("clock_jump", "error", set_s, _SET_S, "s", text, at=topic.stamp_ns)
        elif abs(apart_s) > _CLOCKS_DIFFER_S:
            yield _other_clock(c, topic, of_odometry, apart_s)
        elif apart_s < -EARLY_S and not any(
            one.offset_s for one in c.config.sources if one.name in (topic.inputs[0], c.odometry.input)
        ):  # which somebody has set, and knows better
            other = f"compared with {c.odometry.topic}: its clock is ahead"
            text = f"recorded {-apart_s * 1e3:.0f} ms before the time in its stamps, {other}"
            settings = (offset_setting(c, topic.inputs[0], apart_s),)
            yield topic.finding("latency", "warning", -apart_s, EARLY_S, "s", text, settings=settings)


def _other_clock(c: Columns, topic: TopicColumns, of_odometry: TopicColumns, apart_s: float) -> Finding:
    """A clock that is not that of odometry. Where odometry's alone is not the receiver's, it is odometry's."""
    is_right = abs(float(np.median(topic.lag_s))) < _CLOCKS_DIFFER_S / 2.0
    wrong, right = (of_odometry, topic) if is_right else (topic, of_odometry)
    by_s = apart_s if wrong is topic else -apart_s
    text = f"{wrong.topic}: its stamps are {-by_s:.1f} s away from those of {right.topic}: another clock"
    found = topic.finding("clock_domains", "error", -by_s, _CLOCKS_DIFFER_S, "s", text)
    return replace(found, text=text, settings=(offset_setting(c, wrong.inputs[0], by_s),))


def offset_setting(c: Columns, name: str, by_s: float) -> str:
    """Return the setting that shifts the stamps of an input by so much more."""
    before_s = next(one.offset_s for one in c.config.sources if one.name == name)
    return assignment(f"{name}.offset_s", round(before_s + by_s, 3) + 0.0)


def _order(c: Columns, topic: TopicColumns) -> Iterator[Finding]:
    stamp_ns = topic.stamp_ns
    step_s = np.diff(stamp_ns) * 1e-9
    repeated, back = step_s == 0.0, step_s < 0.0
    share = float(repeated.mean())
    if topic.topic == c.odometry.topic and share > _DUPLICATES and (each_s := rounded_s(c.odometry)):
        text = f"stamps are rounded to {each_s:.3g} s: {share:.1%} are that of the message before"
        found = topic.finding("coarse_stamps", "error", each_s, _COARSE_S, "s", text)
        yield found if each_s > _COARSE_S else replace(found, code="rounded_stamps", severity="note")
    elif topic.use == "odometry" and share > _DUPLICATES:
        text = f"{share:.1%} of the messages have the stamp before: published or recorded twice"
        yield topic.finding("duplicates", "warning", share, _DUPLICATES, "part", text, at=stamp_ns[1:][repeated])
    if not back.any():
        return
    most_s, count, at = -float(step_s.min()), int(back.sum()), stamp_ns[1:][back]
    window_s = c.config.ordering.window_s if topic.use == "odometry" else c.config.ordering.late_s
    if most_s > max(_SET_S, window_s):
        text = f"stamps step back by up to {most_s:.2f} s: the clock was set, or two drives were joined"
        severity: Severity = "error" if c.config.time.on_jump == TimeConfig().on_jump else "note"
        yield topic.finding("time_jump", severity, most_s, _SET_S, "s", text, at=at)
    elif topic.use == "odometry" and most_s > window_s and count > _OUT_OF_ORDER * len(step_s):
        text = f"{count} messages are older than the one before, by up to {most_s * 1e3:.0f} ms"
        settings = (assignment("ordering.window_s", round(1.2 * most_s + 0.005, 3)),)
        yield topic.finding("out_of_order", "warning", most_s, window_s, "s", text, at=at, settings=settings)


def _rate(c: Columns) -> Iterator[Finding]:
    o = c.odometry
    stamp_ns, order = np.unique(o.stamp_ns[o.stamp_ns != 0], return_index=True)
    if len(stamp_ns) < _FEW:
        return
    poses = o.poses[o.stamp_ns != 0][order]
    step_s = np.diff(stamp_ns) * 1e-9
    median_s = float(np.median(step_s))
    most_s = max(_PERIODS * median_s, _LONG_S)
    long = np.flatnonzero(step_s > most_s)
    if len(long):
        way = np.diff(poses, axis=0)[long]
        moved = np.maximum(*(np.linalg.norm(part, axis=1) for part in (way[:, :3], way[:, 3:]))) > _MOVED
        was_set = _was_set(poses, step_s, long)
        for k in long[was_set]:
            span = f"{step_s[k] / 86400.0:.1f} days" if step_s[k] > 86400.0 else f"{step_s[k]:.1f} s"
            text = f"the clock was set forward by {span}: odometry goes on where it was"
            yield o.finding("clock_jump", "warning", step_s[k], most_s, "s", text, 1, at=stamp_ns[k + 1 :])
        long, moved = long[~was_set], moved[~was_set]
    if len(long):
        worst_s, often = float(step_s[long].max()), {1: "once", 2: "twice"}.get(len(long), f"{len(long)} times")
        is_bad = bool((step_s[long][moved] > max(_PERIODS * median_s, 2.0 * _LONG_S)).any())
        text = f"comes at {1.0 / median_s:.0f} Hz, but is silent for more than {most_s:.1f} s {often} "
        text += f"(the longest {worst_s:.2f} s{'; the robot moved meanwhile' if is_bad else ''})"
        severity: Severity = "warning" if is_bad else "note"
        yield o.finding("gap", severity, worst_s, most_s, "s", text, at=stamp_ns[long])
    if 1.0 / median_s < _SLOW_HZ:
        text = f"comes at {1.0 / median_s:.1f} Hz: poses are interpolated over {median_s:.2f} s"
        severity = "warning" if _between(c, stamp_ns) > MOST else "note"
        yield o.finding("slow_odometry", severity, 1.0 / median_s, _SLOW_HZ, "Hz", text, at=stamp_ns)


def _was_set(poses: Array, step_s: Array, gaps: Index) -> Mask:
    """Return in which gaps the clock was set: the robot drives before and after, and in between not for so long."""
    pace = np.linalg.norm(np.diff(poses[:, :3], axis=0), axis=1)
    out = np.zeros(len(gaps), dtype=bool)
    for n, k in enumerate(gaps):
        sides = slice(max(k - _STEPS, 0), k), slice(k + 1, k + 1 + _STEPS)
        speeds = [float(pace[side].sum() / max(step_s[side].sum(), 1e-9)) for side in sides]
        out[n] = min(speeds) > _PACE and pace[k] < _GOES_ON * min(speeds) * step_s[k]
    return out


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
        at = s.stamp_ns[outside]
        ends = [(int(t) - first_ns) * 1e-9 for t in (s.stamp_ns.min(), s.stamp_ns.max())]
        if share < _NEARLY_ALL and _recorded_alone(c, s.topic) > _OUTSIDE:
            after_s = ends[1] - (last_ns - first_ns) * 1e-9
            when = [f"begins {-ends[0]:.1f} s after the first of them"] * (-ends[0] > _MARGIN_NS * 1e-9)
            when += [f"ends {after_s:.1f} s before the last of them"] * (after_s > _MARGIN_NS * 1e-9)
            text = f"{share:.0%} of the sightings were recorded without odometry, which {' and '.join(when)}"
            yield s.finding("odometry_short", "warning", share, _OUTSIDE, "part", text, at=at)
            continue
        span = f"({ends[0]:.1f} to {ends[1]:.1f} s, odometry 0 to {(last_ns - first_ns) * 1e-9:.1f} s)"
        text = f"{share:.0%} of the sightings are stamped outside the time of odometry {span}"
        yield s.finding("no_overlap", "error", share, _OUTSIDE, "part", text, at=at)


def _recorded_alone(c: Columns, name: str) -> float:
    """Return which part of the messages of a topic was recorded before odometry or after it, whatever their stamps."""
    topic, of_odometry = c.topics.get(name), c.topics.get(c.odometry.topic)
    if topic is None or of_odometry is None or not len(topic.log_ns) or not len(of_odometry.log_ns):
        return 0.0
    first_ns, last_ns = of_odometry.log_ns.min() - _MARGIN_NS, of_odometry.log_ns.max() + _MARGIN_NS
    return float(((topic.log_ns < first_ns) | (topic.log_ns > last_ns)).mean())
