"""Checks of fixes and headings against the motion of odometry, and against one another."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from graph_slam_ros.check.columns import Columns, FixColumns
from graph_slam_ros.check.contradictions import factor_setting, turned_mount
from graph_slam_ros.check.odometry import TOGETHER, worst_stretch
from graph_slam_ros.check.pairs import HALF, poses_at
from graph_slam_ros.check.times import MOST_LATE_S, offset_setting
from graph_slam_ros.findings.finding import Finding, Severity
from graph_slam_ros.lie import se2, so3
from graph_slam_ros.typing import Array, Index

_LEAST, _STEP_M, _SIGMAS = 8, 2.0, 6.0  # fixes, and how far apart those are whose motion is compared: m, sigmas
_TURNED_RAD = 0.2  # of steps that tell a mirror
_SCALE, _OFF = 1.5, 0.1  # times: no odometry is so wrong; part of its distances that a fit leaves, or is off by
_SAME_M, _FAR_M = 1e-6, 3.0  # of a fix that stands, and what nobody takes for noise
_STEP_S, _SLIP_M, _SLIP_PART, _SLIP_SIGMAS = 2.0, 2.0, 0.25, 5.0  # a step, and the least of five: of it, of the usual
_OFF_RAD, _STANDS, _SPINS = 0.17, 0.05, 3.0  # ten degrees; of odometry's turns: less, or more, is no heading
_WINDOW_S, _LATE_S, _BETTER = 20.0, 0.15, 0.9  # _BETTER: squares that another time leaves


def check_fixes(c: Columns) -> Iterator[Finding]:
    """Fixes that are mirrored, of another scale, frozen or jump, and headings that count clockwise or are off."""
    decided = ("fix_jumps", "odometry_slips") if any(len(s.stamp_ns) for s in c.sightings) else ()  # by landmarks
    known: tuple[Index, Array] | None = None  # stamps, and by how much odometry's frame is turned in the map
    for f in sorted(c.fixes, key=lambda f: bool(np.isnan(f.points).all())) if len(c.path_ns) > 1 else ():
        use = (f.stamp_ns >= c.path_ns[0]) & (f.stamp_ns <= c.path_ns[-1])
        order = np.flatnonzero(use)[np.argsort(f.stamp_ns[use], kind="stable")]
        if len(order) < _LEAST:
            continue
        f = f.some(order)
        own, yaws = _driven(f, poses_at(f.stamp_ns, c.path_ns, c.path))
        if np.isfinite(f.points).all():
            seen = (list(check(c, f, own)) for check in (_frozen, _turned, _late, _slipped))
            found: list[Finding] = next(filter(None, seen), [])
            yield from (replace(one, severity="warning") if one.code in decided else one for one in found)
            ends = _apart(own, max(_STEP_M, _SIGMAS * f.sigma_m))
            if len(ends) > _LEAST and not any(one.ends or one.code == "fix_mirrored" for one in found):
                at_ns = (f.stamp_ns[ends[1:]] + f.stamp_ns[ends[:-1]]) // 2
                known = at_ns, np.angle(np.diff(f.points[ends]) / np.diff(own[ends]))
        if np.isfinite(f.headings).all():
            yield from _headings(f, yaws, known)


def _driven(f: FixColumns, poses: Array) -> tuple[Array, Array]:
    """Where the antenna is in the frame of odometry, as complex numbers, and the headings there."""
    yaws = np.stack(so3.log(tuple(poses[:, 3:].T)), axis=1)[:, 2]
    return np.asarray(poses[:, 0] + 1j * poses[:, 1] + np.exp(1j * yaws) * complex(*f.T_base_frame[:2])), yaws


def _apart(own: Array, step_m: float) -> Index:
    """Fixes between which the robot has driven so far."""
    chosen = [0]
    for k in range(1, len(own)):
        if abs(own[k] - own[chosen[-1]]) > step_m:
            chosen.append(k)
    return np.array(chosen)


def _mirrored(turns: Array, own: Array) -> tuple[float, float]:
    """The median differences of turns and odometry's, as they are and mirrored, where odometry turns [rad]."""
    at = np.abs(own) > _TURNED_RAD
    if at.sum() < _LEAST:
        return 0.0, 0.0
    now, mirrored = (float(np.median(np.abs(se2.wrap(turns[at] - sign * own[at])))) for sign in (1.0, -1.0))
    return now, mirrored


def _frozen(c: Columns, f: FixColumns, own: Array) -> Iterator[Finding]:
    way_m, moves = np.abs(np.diff(own)), np.abs(np.diff(f.points)) > _SAME_M
    begins = np.flatnonzero(np.concatenate([[True], moves]))
    for k, end in zip(begins, [*(begins[1:] - 1), len(own) - 1], strict=True):
        if (drove_m := float(way_m[k:end].sum())) > _FAR_M:
            span_s = (f.stamp_ns[end] - f.stamp_ns[k]) * 1e-9
            text = f"the fix stands still for {span_s:.0f} s, while odometry drives {drove_m:.0f} m"
            yield f.finding("fix_frozen", "warning", drove_m, _FAR_M, "m", text, at=f.stamp_ns[k:end])


def _turned(c: Columns, f: FixColumns, own: Array) -> Iterator[Finding]:
    """Fixes that are mirrored, of another scale, or jump."""
    ends = _apart(own, max(_STEP_M, _SIGMAS * f.sigma_m))
    if len(ends) > _LEAST:
        moved, driven = np.diff(f.points[ends]), np.diff(own[ends])
        now, mirrored = _mirrored(np.angle(moved[1:] / moved[:-1]), np.angle(driven[1:] / driven[:-1]))
        ways, own_ways = (np.stack([some.real, some.imag], axis=1) for some in (moved, driven))
        linear, left, *_ = np.linalg.lstsq(own_ways, ways, rcond=None)  # degrees of latitude and longitude differ
        is_linear = left.sum() < _OFF * np.sum(ways**2)
        if (mirrored < HALF * now and now > _TURNED_RAD) or (is_linear and np.linalg.det(linear) < 0.0):
            what = "latitude and longitude, or east and north, are exchanged, or odometry's position is mirrored"
            text = f"fixes turn right where odometry turns left: {what}"
            yield f.finding("fix_mirrored", "error", now, mirrored, "rad", text, settings=(f"{f.input}.use=none",))
            return
        is_odometry = is_linear and np.linalg.cond(linear) < 1.0 + _OFF
        ways_m = np.median(np.abs(moved)), np.median(np.abs(driven))
        factor = float(abs(np.linalg.det(linear)) ** 0.5 if is_odometry else ways_m[0] / ways_m[1])
        spread = float(np.median(np.abs(np.abs(moved) / np.abs(driven) - factor)) / len(moved) ** 0.5)
        text = f"fixes move {factor:.3g} m for each metre of odometry"
        if factor < _OFF or not (is_odometry or 1.0 / _SCALE < factor < _SCALE):
            text += ": are latitude and longitude in degrees, and odometry in metres?"
            yield f.finding("unrelated", "error", factor, _SCALE, "times", text)
            return
        if abs(factor - 1.0) > max(_OFF, _SIGMAS * spread):
            setting = factor_setting("odometry.distance_factor", c.config.odometry.distance_factor * factor, 100.0)
            severity: Severity = "error" if is_odometry else "warning"  # noise lengthens each way
            settings = setting if is_odometry else ()
            yield f.finding("odometry_scale", severity, factor, 1.0 + _OFF, "times", text, settings=settings)
    step_m, way_m = np.abs(np.diff(f.points)), np.abs(np.diff(own))
    far_m = max(_FAR_M, 2.0 * _SIGMAS * f.sigma_m)
    jumps = (step_m - way_m > far_m) & (np.diff(f.stamp_ns) < _STEP_S * 1e9)
    if jumps.any():
        often = "once" if jumps.sum() == 1 else f"{jumps.sum()} times"
        stays = bool(abs(np.diff(f.points)[jumps].sum()) > far_m)
        most_m = float(step_m[jumps].max())
        kind: Severity = "error" if stays else "warning"
        text = f"the fix jumps {often}, by up to {most_m:.0f} m{', and stays there' * stays}"
        yield f.finding("fix_jumps", kind, most_m, far_m, "m", text, at=f.stamp_ns[1:][jumps])


def _late(c: Columns, f: FixColumns, own: Array) -> Iterator[Finding]:
    """Fixes that agree with odometry better at other times, in either half of the windows of the drive."""
    antenna, _ = _driven(f, c.path)
    path_s, at_s = ((some_ns - c.path_ns[0]) * 1e-9 for some_ns in (c.path_ns, f.stamp_ns))
    begins = np.flatnonzero(np.diff(at_s // _WINDOW_S)) + 1
    windows = [k for k in np.split(np.arange(len(at_s)), begins) if len(k) >= _LEAST]
    tried_s = np.arange(-MOST_LATE_S, MOST_LATE_S + 0.01, _LATE_S / 3.0)
    paths = (np.interp(at_s - late_s, path_s, antenna) for late_s in tried_s)
    left = [[_left(own[k], f.points[k]) for k in windows] for own in paths]
    halves = [np.sum([row[n::2] for row in left], axis=1) for n in (0, 1)]
    first_s, second_s, late_s = (float(tried_s[np.argmin(some)]) for some in (*halves, sum(halves)))
    is_better = min(sum(halves)) < _BETTER * sum(halves)[len(tried_s) // 2]
    if is_better and _LATE_S <= abs(late_s) < MOST_LATE_S - 0.01 and abs(first_s - second_s) < _LATE_S:
        when = f"{abs(late_s) * 1e3:.0f} ms {'earlier' if late_s > 0.0 else 'later'} than stamped"
        settings = (offset_setting(c, f.input, -late_s),)
        text = f"fixes agree with odometry best {when}, or their antenna is elsewhere on the robot"
        yield f.finding("clock_offset", "warning", -late_s, _LATE_S, "s", text, settings=settings)


def _left(own: Array, points: Array) -> float:
    """The sum of squares that is left of points when a path is turned and shifted onto them."""
    return float(len(own) * (own.var() + points.var()) - 2.0 * abs(np.vdot(own - own.mean(), points)))


def _slipped(c: Columns, f: FixColumns, own: Array) -> Iterator[Finding]:
    """A stretch in which fixes move by far more or less than odometry: of the two, one is wrong."""
    begins = np.flatnonzero(np.diff((f.stamp_ns - f.stamp_ns[0]) // round(_STEP_S * 1e9), prepend=-1))
    counts = np.diff([*begins, len(own)])
    moved, driven = (np.abs(np.diff(np.add.reduceat(x, begins) / counts))[:, None] for x in (f.points, own))
    if found := worst_stretch(moved - driven, driven, np.array([_SLIP_M]), _SLIP_PART, _SLIP_SIGMAS):
        k, _, more_m, limit_m, _ = found
        by = f"fixes move {abs(more_m):.1f} m {'more' if more_m > 0.0 else 'less'} than {c.odometry.topic} in 10 s"
        text = f"{by}: odometry slips there, or the fixes are wrong, and fixes alone do not tell which"
        yield f.finding(
            "odometry_slips", "error", abs(more_m), limit_m, "m", text, TOGETHER, at=f.stamp_ns[begins[k] :]
        )


def _headings(f: FixColumns, yaws: Array, known: tuple[Index, Array] | None) -> Iterator[Finding]:
    _, ends = np.unique((f.stamp_ns - f.stamp_ns[0]) // 10**9, return_index=True)  # one in each second
    steps = [se2.wrap(np.diff(some[ends])) for some in (f.headings, yaws)]
    now, mirrored = _mirrored(*steps)
    if now > _TURNED_RAD:
        turned, own = (float(np.abs(some).sum()) for some in steps)
        is_faulty = mirrored < HALF * now or not _STANDS * own < turned < _SPINS * own
        mirror = "turns to the right where odometry turns to the left: it counts clockwise (NED)"
        other = f"turns {turned:.1f} rad where odometry turns {own:.1f} rad: "
        other += "does it stand, or is it in degrees?" if is_faulty else "which of them is right?"
        code, what = ("heading_clockwise", mirror) if mirrored < HALF * now else ("unrelated", other)
        settings, limit = (f"{f.input}.use=none",) * is_faulty, min(mirrored, _TURNED_RAD)
        yield f.finding(code, "error", now, limit, "rad", f"its heading {what}", settings=settings)
    elif known is not None:
        near = np.clip(np.searchsorted(f.stamp_ns, known[0]), 0, len(yaws) - 1)
        turned = np.exp(1j * (f.headings[near] - yaws[near] - known[1]))
        off = float(np.angle(np.median(turned.real) + 1j * np.median(turned.imag)))
        if abs(off) > _OFF_RAD and np.median(np.abs(np.angle(turned * np.exp(-1j * off)))) < HALF * abs(off):
            text = f"its heading is {np.degrees(off):.0f} degrees off the course of the fixes (0 is east)"
            quarter = round(off / (0.5 * np.pi)) * 0.5 * np.pi
            off = quarter if abs(off - quarter) < _OFF_RAD else off
            turn = (0.0, 0.0, 0.0, 0.0, 0.0, np.sin(0.5 * off), np.cos(0.5 * off))
            settings = turned_mount(f.input, f.frame, f.T_base_frame, turn) if f.frame else ()
            yield f.finding("heading_offset", "error", off, _OFF_RAD, "rad", text, settings=settings)
