"""Checks of odometry alone: whether it moves, jumps, leaves the plane, and agrees with its twist."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from graph_slam_ros.check.columns import Columns, OdometryColumns
from graph_slam_ros.check.pairs import poses_at
from graph_slam_ros.check.times import rounded_s
from graph_slam_ros.chi_square import quantile
from graph_slam_ros.config.pipeline import OdometryConfig
from graph_slam_ros.findings.finding import Finding, Severity
from graph_slam_ros.lie import se3, so3
from graph_slam_ros.messages.inputs.odometry import UNUSED
from graph_slam_ros.typing import Array, Mask

LEAST = 10
"""Messages of odometry below which nothing is known of it."""

# In brackets: by how much less and more the findings of 255 recordings are the same, faults and robots among them.
_FASTEST_M_S, _FASTEST_RAD_S = 40.0, 12.0  # of any robot (x 0.1, x 8), (x 0.5, x 2)
_LEAST_S = 0.02  # of steps that are shorter, noise would pass for a turn
_STEP, _TIMES = 0.1, 5.0  # m and rad, and times the fastest: longer is a jump (x 1, x 1)
_FEW, _FEW_JUMPS, _MANY = 0.01, 5.0, 0.1  # may be jumps: a share (x 0.5, x 2), so many (x 0.1, x 2), of few messages
_CORRECTED = 3  # jumps: a driver that restarts, or is lifted, makes fewer
_LIMIT, _LEAST_LIMIT_M_S = 2.5, 0.5  # above which odometry jumps: times the fastest (x 0.1, x 2), and at least
_IRREGULAR = 2.5  # spread of times between messages, in medians; 3.2 where they come at random
_AT_ZERO = 1e-9  # m and rad: of a driver that was restarted
_STILL_M, _STILL_RAD = 0.5, 1.0  # of a whole drive (x 0.1, x 8)
_NO_TURN_RAD, _TURNS = 1e-6, 0.2  # _TURNS: of a quaternion's numbers (x 0.1, x 8)
_BENDS = 0.05  # of the squares of a way, those across it (x 0.1, x 8)
_SIDEWAYS = 0.2  # of the speed ahead: wheels that cannot have no such twist (x 0.5, x 2)
_WINDOW_S, _LONGEST_S = 1.0, 3.0  # over which pose and twist are compared (x 1, x 1), and with a gap (x 0.5, x 2)
_LEAST_WIDTH = 4  # messages in a window: between fewer, the speed may be any (0, x 2)
SCALE = 0.1  # of a factor: less is no other unit (x 0.5, x 1)
_EXPLAINED, _UNEXPLAINED = 0.5, 0.7  # a factor leaves: clearly explained (x 1, x 1), clearly not (x 0.1, x 1)
_AT_REST = 0.05  # of the root mean square (x 1, x 8)
_LATERAL, _FITS, _WORSE_M = 0.1, 0.3, 0.02  # sideways by ahead (x 0.1, x 2); of what is left, and that (x 0.1, x 8)
_TINY, _USELESS, _SLOWEST_M_S = 1e-3, 3.0, 0.05  # sigmas by the fastest speed, which is at least that (x 0.1, x 8)
_TINY_RAD_S = 1e-4  # no wheels are so good
_OUT_OF_PLANE = 0.05  # of all poses: with more, the robot does not move in a plane (x 0.1, x 8)
TOGETHER = 5
"""Steps that are summed for a slip."""
_ROUNDS = 10  # of reweighting
_LEAST_STRETCHES = 20  # of fewer sums the usual scale is not known
_ELSEWHERE_M, _OTHER_ROBOT_M = 0.3, 2.0  # of poses that are not used; another driver begins where this one does
_UNITS = {
    -1.0: "mirrored",
    57.29578: "radians for degrees",
    1.0 / 57.29578: "degrees for radians",
    1000.0: "metres for thousands",
    1e-3: "millimetres for metres",
}
_DENSITY = ("odometry.noise=density",)


@dataclass(frozen=True, slots=True, eq=False)
class Steps:
    """The motion from one usable message to the next.

    Attributes
    ----------
    of : the n + 1 messages
    dt : (n,) seconds, positive
    moved, turned : (n, 3) in the frame of the earlier pose, metres and radians
    is_short : (n,) whether no gap is between them
    fastest_m_s, fastest_rad_s : the fastest of those, without a few that may be jumps
    """

    of: OdometryColumns
    dt: Array
    moved: Array
    turned: Array
    is_short: Mask
    fastest_m_s: float
    fastest_rad_s: float

    @property
    def fastest_turn_rad_s(self) -> float:
        """The fastest turn rate, without what noise makes of the shortest steps."""
        turned = np.linalg.norm(self.turned[self.is_short], axis=1)
        return _without_jumps(turned / np.maximum(self.dt[self.is_short], _LEAST_S))

    @property
    def jumps(self) -> Mask:
        """(n,) Steps that are far longer than the others."""
        dt = np.maximum(self.dt, float(np.median(self.dt)))
        far = np.linalg.norm(self.moved, axis=1) > _STEP + _TIMES * self.fastest_m_s * dt
        return far | (np.linalg.norm(self.turned, axis=1) > _STEP + _TIMES * self.fastest_rad_s * dt)


def _without_jumps(speeds: Array) -> float:
    """Return the speed that all of these (n,) but a few keep: 1 % of many, and up to five of few."""
    return float(np.quantile(speeds, 1.0 - max(_FEW, min(_FEW_JUMPS / max(len(speeds), 1), _MANY))))


def _usable(o: OdometryColumns) -> OdometryColumns:
    """The messages with a stamp and a pose, in order of stamp; of equal stamps the first."""
    norm = np.linalg.norm(o.poses[:, 3:], axis=1)
    usable = np.isfinite(o.poses).all(axis=1) & (np.abs(o.poses[:, :3]).max(axis=1, initial=0.0) < 1e9)
    usable &= (o.stamp_ns != 0) & (np.abs(norm - 1.0) < 0.1)
    _, first = np.unique(o.stamp_ns[usable], return_index=True)
    return o.some(np.flatnonzero(usable)[first])


def steps_of(o: OdometryColumns) -> Steps | None:
    """The steps of odometry in order of stamp; None where there are too few."""
    o = _usable(o)
    if len(o.poses) < LEAST:
        return None
    unit = o.poses[:, 3:] / np.linalg.norm(o.poses[:, 3:], axis=1)[:, None]
    poses = np.concatenate([o.poses[:, :3], unit], axis=1)
    motion = se3.between(tuple(poses[:-1].T), tuple(poses[1:].T))
    moved = np.stack(motion[:3], axis=1)
    turned = np.stack(so3.log(tuple(motion[3:])), axis=1)
    dt = np.diff(o.stamp_ns) * 1e-9
    is_short = dt < max(1.0, 5.0 * float(np.median(dt)))
    rate = np.maximum(dt, float(np.median(dt)))
    speeds = np.stack([np.linalg.norm(moved, axis=1) / rate, np.linalg.norm(turned, axis=1) / rate])
    return Steps(o, dt, moved, turned, is_short, *map(_without_jumps, speeds[:, is_short]))


def twist_factor(o: OdometryColumns) -> float:
    """Return how many times as far as its twist says the pose moves; NaN where it has none."""
    steps = steps_of(o)
    if steps is None:
        return np.nan
    said = np.linalg.norm(steps.of.twist[1:, :3], axis=1) * steps.dt
    return float(np.linalg.norm(steps.moved, axis=1).sum() / said.sum())


def of_one_publisher(c: Columns, *, is_live: bool = False) -> Columns:
    """Return these columns without the odometry that other publishers on its topic have sent.

    It was refused because it does not continue the odometry in use, and is by itself the motion of a robot that is
    measured again and again. What is not is an outlier, or of the wrong unit, and stays. Messages that a node has
    collected (``is_live``) come late and in bursts, and not all are counted yet: neither times nor counts decide.
    """
    o = c.odometry
    is_one = not is_live and c.counters[o.input, "other_publisher"] < LEAST
    if len(c.path_ns) < 2 or is_one or rounded_s(o) > 0.0:
        return c
    is_used, _ = _used(c)
    others, topic = steps_of(o.some(~is_used)), c.topics[o.topic]
    of_used = replace(c, odometry=o.some(is_used))
    if len(topic.stamp_ns) == len(is_used):
        of_used = replace(of_used, topics={**c.topics, o.topic: topic.some(is_used)})
    if others is None:
        return of_used if is_live and is_used.sum() >= LEAST else c
    if others.fastest_m_s > _FASTEST_M_S or others.fastest_turn_rad_s > _FASTEST_RAD_S:
        return c
    early_s, usual_s, late_s = np.percentile(others.dt, [10.0, 50.0, 90.0])
    return of_used if is_live or late_s - early_s <= _IRREGULAR * usual_s else c


def _used(c: Columns) -> tuple[Mask, Array]:
    """Which odometry is used, of one stamp the nearest to the path, and how far each is from it [m]."""
    o = c.odometry
    places = poses_at(o.stamp_ns, c.path_ns, c.path)[:, :3]
    apart_m = np.linalg.norm(o.poses[:, :3] * c.config.odometry.distance_factor - places, axis=1)
    order, is_used = np.lexsort((apart_m, o.stamp_ns)), np.isin(o.stamp_ns, c.path_ns)
    is_used[order[1:]] &= np.diff(o.stamp_ns[order]) > 0
    return is_used, apart_m


def check_publishers(c: Columns) -> Iterator[Finding]:
    """Odometry of which some is elsewhere: another robot's, or of another driver, whose drift differs."""
    o, (is_used, apart_m) = c.odometry, _used(c)
    used, others_m = steps_of(o.some(is_used)), apart_m[~is_used]
    away_m, first_m = float(np.median(others_m)), float(np.median(others_m[:LEAST]))
    if away_m > _ELSEWHERE_M:
        hops_m = np.zeros(0) if used is None else np.linalg.norm(used.moved[used.jumps], axis=1)
        is_mixed = np.count_nonzero(hops_m > _ELSEWHERE_M) >= _CORRECTED
        severity: Severity = "error" if is_mixed or first_m > _OTHER_ROBOT_M else "warning"
        text = f"two robots or drivers take turns: {len(others_m)} of its poses are {away_m:.1f} m elsewhere"
        yield o.finding("two_publishers", severity, away_m, _ELSEWHERE_M, "m", text, at=o.stamp_ns[~is_used])


def check_odometry(c: Columns) -> Iterator[Finding]:
    """The odometry that is used, by its own messages alone."""
    steps = steps_of(c.odometry)
    if steps is None:
        count = len(_usable(c.odometry).poses)
        text = f"{count} of {len(c.odometry.poses)} messages are usable; {LEAST} are needed"
        yield c.odometry.finding("no_odometry", "error", count, LEAST, "messages", text)
        return
    o = steps.of
    if steps.fastest_m_s > min(_FASTEST_M_S, c.config.odometry.max_speed_m_s):
        text = f"the robot drives at {steps.fastest_m_s:.0f} m/s: is its position in metres?"
        yield o.finding("units", "error", steps.fastest_m_s, _FASTEST_M_S, "m/s", text)
        return
    if (fastest := steps.fastest_turn_rad_s) > _FASTEST_RAD_S:
        text = f"the orientation turns at {fastest:.0f} rad/s: are its angles in radians?"
        yield o.finding("units", "error", fastest, _FASTEST_RAD_S, "rad/s", text)
        return
    jumps = steps.jumps
    yield from _jumps(steps, jumps, c.config.odometry.max_speed_m_s)
    smooth = steps.is_short & ~jumps
    total_m = float(np.linalg.norm(steps.moved[smooth], axis=1).sum())
    total_rad = float(np.linalg.norm(steps.turned[smooth], axis=1).sum())
    if total_m < _STILL_M and total_rad < _STILL_RAD:
        speed_m_s = float(np.median(np.linalg.norm(o.twist[:, :3], axis=1)))
        if speed_m_s > _SLOWEST_M_S:
            text = f"its pose never changes, though its twist says {speed_m_s:.1f} m/s"
            yield o.finding("pose_stands", "error", speed_m_s, _SLOWEST_M_S, "m/s", text)
            return
        text = f"it moves {total_m:.2f} m and {np.degrees(total_rad):.0f} degrees in {steps.dt.sum():.0f} s"
        yield o.finding("static", "warning", total_m, _STILL_M, "m", text)
        return
    quaternions = np.abs(o.poses[:, 3:])
    w_first = quaternions[:, 1:3].max() < _NO_TURN_RAD and np.ptp(quaternions[:, 0]) > _TURNS
    if w_first or (_has_no_orientation(steps, smooth, total_rad) and not _drives_sideways(o)):
        text = f"its orientation never changes in {total_m:.0f} m, and it drives round bends"
        text = "it rolls, and never turns: does w come first in its quaternions?" if w_first else text
        yield o.finding("no_orientation_of_odometry", "error", total_rad, 0.0, "rad", text)
        return
    counted = c.counters.as_dict().get(o.input, {})
    yield from leaves_plane(o.input, counted, len(c.odometry.poses), o.topic)
    if c.config.odometry.noise == "density":
        return
    if np.isfinite(o.twist).all() and o.twist.any():
        yield from _twist(steps, jumps, c.config.odometry.distance_factor)
    if np.isfinite(c.odometry.twist).any():
        yield from _covariance(c.odometry, steps)


def _has_no_orientation(steps: Steps, smooth: Mask, total_rad: float) -> bool:
    """Return whether the robot never turns, and its way is no line, straight or to and fro."""
    moved = steps.moved[smooth, :2]
    least, most = np.linalg.eigvalsh(moved.T @ moved)
    return total_rad < _NO_TURN_RAD and bool(least > _BENDS * most)


def _drives_sideways(o: OdometryColumns) -> bool:
    """Return whether the robot says that it drives sideways: then it needs no turn to go round a bend."""
    ahead_m_s, sideways_m_s = np.nanmax(np.abs(o.twist[:, :2]), axis=0, initial=0.0)
    return bool(sideways_m_s > _SIDEWAYS * max(ahead_m_s, 1e-9))


def _jumps(steps: Steps, jumps: Mask, max_speed_m_s: float) -> Iterator[Finding]:
    poses = steps.of.poses
    at_zero = (np.abs(poses[1:, :6]) < _AT_ZERO).all(axis=1) & (np.linalg.norm(poses[:-1, :3], axis=1) > _STILL_M)
    for code, is_there in (("odometry_reset", at_zero), ("odometry_jumps", jumps & ~at_zero)):
        count = int(is_there.sum())
        if not count:
            continue
        most_m = float(np.linalg.norm(steps.moved[is_there], axis=1).max())
        most_deg = float(np.degrees(np.linalg.norm(steps.turned[is_there], axis=1).max()))
        by = f"by up to {most_m:.2f} m and {most_deg:.0f} degrees in one step"
        often = "once" if count == 1 else f"{count} times"
        text, settings = f"jumps {often}, {by}", tuple[str, ...]()
        slowest_m_s = float((np.linalg.norm(steps.moved, axis=1) / steps.dt)[is_there].min())
        limit_m_s = max(_LEAST_LIMIT_M_S, _LIMIT * steps.fastest_m_s)
        if code == "odometry_reset":
            text = f"goes back to zero {often}: its driver was restarted"
        elif count >= _CORRECTED:
            code, text = "corrected", f"jumps {count} times, {by}: is it the output of a localiser?"
        elif limit_m_s < slowest_m_s <= max_speed_m_s:  # else a run finds the jump itself
            settings = (f"odometry.max_speed_m_s={limit_m_s:.2g}",)
        elif max_speed_m_s < min(slowest_m_s, OdometryConfig().max_speed_m_s):
            continue  # somebody has set the limit, so that a run begins anew there
        at = steps.of.stamp_ns[1:][is_there]
        yield steps.of.finding(code, "warning", count, 0, "times", text, at=at, settings=settings)


def leaves_plane(name: str, counted: Mapping[str, int], received: int, topic: str = "") -> Iterator[Finding]:
    """Yield that an odometry is not of a plane, if many of its poses are outside."""
    if (out := counted.get("out_of_plane", 0)) > _OUT_OF_PLANE * received:
        text, settings = f"{name} leaves the plane: these are three dimensions", ("world.dimensions=3",)
        part = out / max(received, 1), _OUT_OF_PLANE, "part"
        yield Finding("out_of_plane", "error", *part, text, topic, count=out, settings=settings, source=name)


def _twist(steps: Steps, jumps: Mask, applied: float) -> Iterator[Finding]:
    """The twist against the pose, over windows of a second: it may hold until or since its message."""
    width = max(1, round(_WINDOW_S / float(np.median(steps.dt))))
    starts = np.arange(0, len(steps.dt) - width + 1, max(1, width // 2))
    clock = np.concatenate([[0.0], np.cumsum(steps.dt)])
    starts = starts[clock[starts + width] - clock[starts] < _LONGEST_S]
    if not len(starts):
        return

    def sums(rows: Array) -> Array:
        total = np.concatenate([np.zeros((1, 3)), np.cumsum(np.where(jumps[:, None], 0.0, rows), axis=0)])
        return np.asarray(total[starts + width] - total[starts])

    moved, turned = sums(steps.moved), sums(steps.turned)
    o, twist = steps.of, steps.of.twist
    fits = []
    for rows in (twist[:-1], twist[1:]):
        driven, rotated = (sums(part * steps.dt[:, None]) for part in (rows[:, :3], rows[:, 3:]))
        fits.append((ratio(driven, moved), ratio(rotated, turned)))
    speed, rate = min(fits, key=lambda pair: pair[0][1] + pair[1][1])
    if _in_odom(steps, sums, moved):
        text = f"the twist is given along the axes of {o.frame}; nav_msgs/Odometry has those of {o.child}"
        yield o.finding("twist_frame", "warning", 1.0, _FITS, "times", text, settings=_DENSITY)
        return
    for what, (factor, left), way in (("speed", speed, moved), ("turn rate", rate, turned)):
        total = np.abs(way).sum()
        if total < 1.0 or not np.isfinite(factor):
            continue
        unit = next((why for k, why in _UNITS.items() if abs(factor / k - 1.0) < SCALE), "")
        is_other = min(abs(factor - 1.0), abs(applied * factor - 1.0)) > SCALE
        if is_other and left < _EXPLAINED and (unit or width >= _LEAST_WIDTH):
            times = f"{factor:.3g} times as far as the {what} of the twist says"
            text = f"the pose moves {times} ({unit or 'another scale'})"
            yield o.finding("twist_scale", "warning", factor, SCALE, "times", text, settings=_DENSITY)
        elif left > _UNEXPLAINED and total > 5.0 and width >= _LEAST_WIDTH:
            text = f"the {what} of the twist does not explain {min(left, 1.0):.0%} of the motion of the pose"
            yield o.finding("twist_unrelated", "warning", left, _UNEXPLAINED, "part", text, settings=_DENSITY)


def _in_odom(steps: Steps, sums: Callable[[Array], Array], moved: Array) -> bool:
    """Return whether the linear twist fits the motion along the axes of the odometry frame far better."""
    turns = steps.of.poses[:-1, 3:]
    along = np.stack(so3.act(tuple(turns.T), tuple(steps.moved.T)), axis=1)
    driven = sums(steps.of.twist[1:, :3] * steps.dt[:, None])
    if np.abs(driven[:, 1]).sum() < _LATERAL * np.abs(driven[:, 0]).sum():
        return False
    fixed = float(np.median(np.linalg.norm(sums(along) - driven, axis=1)))
    body = float(np.median(np.linalg.norm(moved - driven, axis=1)))
    return body > _WORSE_M and fixed < _FITS * body


def ratio(x: Array, y: Array) -> tuple[float, float]:
    """Robust factor from x to y (both (n, 3)), and the part of y that it leaves unexplained.

    Rows in which both are next to zero are left out: a robot that stands for half of the time has medians of zero.
    """
    size = np.linalg.norm(y, axis=1)
    if np.abs(x).sum() < 1e-9 or not size.any():
        return np.nan, 1.0
    moves = np.any([row > _AT_REST * np.sqrt((row**2).mean()) for row in (size, np.linalg.norm(x, axis=1))], axis=0)
    x, y, size = x[moves], y[moves], size[moves]
    factor = float(fitted(x.reshape(-1, 1), y.ravel())[0][0])
    large = size >= np.median(size)
    left = np.linalg.norm(y - factor * x, axis=1)[large]
    return factor, float(np.median(left) / (np.median(size[large]) + 1e-9))


def fitted(rows: Array, y: Array) -> tuple[Array, float]:
    """Robust least squares, with the sigma of the last number if the others were known."""
    weight = np.ones(len(y))
    for _ in range(_ROUNDS):
        found = np.linalg.lstsq(rows * weight[:, None], y * weight, rcond=None)[0]
        left = np.abs(rows @ found - y)
        weight = 1.0 / np.hypot(1.0, left / (3.0 * np.median(left) + 1e-6))
    return np.asarray(found), float(np.median(left) / np.linalg.norm(rows[:, -1] * weight))


Stretch: TypeAlias = tuple[int, int, float, float, float]


def worst_stretch(errors: Array, sizes: Array, least: Array, part: float, sigmas: float) -> Stretch | None:
    """Return where odometry is worst over some steps, if it is far worse there than in the rest of the drive.

    The errors (n, c) of its steps are summed: one is as rough as its landmarks. Their scale is that of the middle half
    of the sums, so a wrong factor, which all have, is none. ``least``, a part of the sizes (n, c), and some sigmas are
    no error. Returned are the first step, the column, and of it the sum, its limit and its scale.
    """
    if len(errors) < _LEAST_STRETCHES + TOGETHER - 1:
        return None
    errors, sizes = (np.stack([np.convolve(x, np.ones(TOGETHER), "valid") for x in rows.T]) for rows in (errors, sizes))
    errors = errors - np.median(errors, axis=1, keepdims=True)
    scale = np.median(np.abs(errors), axis=1) / quantile(0.5, 1) ** 0.5
    limits = np.maximum(np.maximum(sigmas * scale, least)[:, None], part * sizes)
    column, first = (int(k) for k in np.unravel_index(np.argmax(np.abs(errors) / limits), errors.shape))
    error, limit = float(errors[column, first]), float(limits[column, first])
    return (first, column, error, limit, float(scale[column])) if abs(error) > limit else None


def _covariance(o: OdometryColumns, steps: Steps) -> Iterator[Finding]:
    """The variances of the twist against what the robot does."""
    used = o.variances[:, [0, 1, 5]]
    if not used.any() or (np.median(used, axis=0) >= UNUSED).any():
        return
    sigmas, speed = np.sqrt(np.median(used, axis=0)), max(steps.fastest_m_s, _SLOWEST_M_S)
    if sigmas[0] > _USELESS * speed:
        text = f"the sigma of the twist is {sigmas[0]:.2g} m/s, but the robot drives at most {speed:.2g} m/s"
        yield o.finding("covariance_useless", "warning", sigmas[0] / speed, _USELESS, "times", text, settings=_DENSITY)
    elif 0.0 < sigmas[0] < _TINY * speed or 0.0 < sigmas[2] < _TINY_RAD_S:
        text = f"the twist has sigmas of {sigmas[0]:.1g} m/s, {sigmas[2]:.1g} rad/s: no wheels are so good"
        yield o.finding("covariance_tiny", "error", sigmas[0] / speed, _TINY, "times", text, settings=_DENSITY)
