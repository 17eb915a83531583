"""Checks of fixes and headings against the motion of odometry, and against one another."""

from collections.abc import Iterator

import numpy as np

from graph_slam_ros.check.columns import Columns, FixColumns
from graph_slam_ros.check.contradictions import turned_mount
from graph_slam_ros.check.finding import Finding, where
from graph_slam_ros.check.pairs import poses_at
from graph_slam_ros.lie import se2, so3
from graph_slam_ros.typing import Array, Index

_LEAST, _STEP_M, _SIGMAS, _SCALE = 8, 2.0, 6.0, 1.5
_TURNED_RAD, _HALF, _OFF_RAD, _NEARLY_RAD = 0.2, 0.5, 0.17, 0.1
_SAME_M, _FROZEN_M, _JUMP_M, _SOON_S, _OFF = 1e-6, 3.0, 3.0, 2.0, 0.1  # _OFF: of odometry's distances


def check_fixes(c: Columns) -> Iterator[Finding]:
    """Fixes that are mirrored, of another scale, frozen or jump, and headings that count clockwise or are off."""
    path_ns, path = c.path_ns, c.path
    known: tuple[Index, Array] | None = None  # stamps, and by how much odometry's frame is turned in the map
    for f in sorted(c.fixes, key=lambda f: bool(np.isnan(f.points).all())) if len(path_ns) > 1 else ():
        use = (f.stamp_ns >= path_ns[0]) & (f.stamp_ns <= path_ns[-1])
        order = np.flatnonzero(use)[np.argsort(f.stamp_ns[use], kind="stable")]
        if len(order) < _LEAST:
            continue
        stamp_ns, points, headings = f.stamp_ns[order], f.points[order], f.headings[order]
        poses = poses_at(stamp_ns, path_ns, path)
        factor = c.config.odometry.distance_factor
        own, yaws = poses[:, 0] + 1j * poses[:, 1], np.stack(so3.log(tuple(poses[:, 3:].T)), axis=1)[:, 2]
        if np.isfinite(points).all():
            found = list(_positions(f, stamp_ns, points, own, factor))
            yield from found
            ends = _apart(own, max(_STEP_M, _SIGMAS * f.sigma_m))
            if len(ends) > _LEAST and not any(one.severity == "error" for one in found):
                at_ns = (stamp_ns[ends[1:]] + stamp_ns[ends[:-1]]) // 2
                known = at_ns, np.angle(np.diff(points[ends]) / np.diff(own[ends]))
        if np.isfinite(headings).all():
            yield from _headings(f, stamp_ns, headings, yaws, known)


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


def _positions(f: FixColumns, stamp_ns: Index, points: Array, own: Array, applied: float) -> Iterator[Finding]:
    at, ends = where(f.topic, stamp_ns), _apart(own, max(_STEP_M, _SIGMAS * f.sigma_m))
    if len(ends) > _LEAST:
        moved, driven = np.diff(points[ends]), np.diff(own[ends])
        now, mirrored = _mirrored(np.angle(moved[1:] / moved[:-1]), np.angle(driven[1:] / driven[:-1]))
        if mirrored < _HALF * now and now > _TURNED_RAD:
            what = "latitude and longitude, or east and north, are exchanged, or odometry's position is mirrored"
            text = f"{f.topic}: fixes turn right where odometry turns left: {what}"
            at = where(f.topic, stamp_ns, settings=(f"{f.input}.use=none",))
            yield Finding("fix_mirrored", "error", now, mirrored, "rad", text, **at)
            return
        factor = float(np.median(np.abs(moved)) / np.median(np.abs(driven)))
        spread = float(np.median(np.abs(np.abs(moved) / np.abs(driven) - factor)) / len(moved) ** 0.5)
        if not 1.0 / _SCALE < factor < _SCALE:
            text = f"{f.topic}: fixes move {factor:.2g} m for each metre of odometry: are both metres?"
            yield Finding("unrelated", "error", factor, _SCALE, "times", text, **at)
            return
        if abs(factor - 1.0) > max(_OFF, _SIGMAS * spread):
            text = f"{f.topic}: fixes move {factor:.3g} m for each metre of odometry"
            at = where(f.topic, stamp_ns, settings=(f"odometry.distance_factor={applied * factor:.4g}",))
            yield Finding("odometry_scale", "warning", factor, 1.0 + _OFF, "times", text, **at)
    step_m, way_m = np.abs(np.diff(points)), np.abs(np.diff(own))
    begins = np.flatnonzero(np.concatenate([[True], step_m > _SAME_M]))
    for k, end in zip(begins, [*(begins[1:] - 1), len(points) - 1], strict=True):
        if (drove_m := float(way_m[k:end].sum())) > _FROZEN_M:
            span_s = (stamp_ns[end] - stamp_ns[k]) * 1e-9
            text = f"{f.topic}: the fix stands still for {span_s:.0f} s, while odometry drives {drove_m:.0f} m"
            at = where(f.topic, stamp_ns[k:end])
            yield Finding("fix_frozen", "warning", drove_m, _FROZEN_M, "m", text, **at)
            step_m[end : end + 1] = 0.0
    far_m = max(_JUMP_M, 2.0 * _SIGMAS * f.sigma_m)
    jumps = (step_m - way_m > far_m) & (np.diff(stamp_ns) < _SOON_S * 1e9)
    if jumps.any():
        text = f"{f.topic}: the fix jumps {int(jumps.sum())} times, by up to {step_m[jumps].max():.0f} m"
        at = where(f.topic, stamp_ns[1:][jumps])
        yield Finding("fix_jumps", "warning", float(step_m[jumps].max()), far_m, "m", text, **at)


def _headings(
    f: FixColumns, stamp_ns: Index, headings: Array, yaws: Array, known: tuple[Index, Array] | None
) -> Iterator[Finding]:
    _, ends = np.unique((stamp_ns - stamp_ns[0]) // 10**9, return_index=True)  # one in each second
    now, mirrored = _mirrored(se2.wrap(np.diff(headings[ends])), se2.wrap(np.diff(yaws[ends])))
    if mirrored < _HALF * now and now > _TURNED_RAD:
        text = f"{f.topic}: its heading turns to the right where odometry turns to the left: it counts clockwise (NED)"
        at = where(f.topic, stamp_ns, settings=(f"{f.input}.use=none",))
        yield Finding("heading_clockwise", "error", now, mirrored, "rad", text, **at)
    elif known is not None:
        near = np.clip(np.searchsorted(stamp_ns, known[0]), 0, len(stamp_ns) - 1)
        turned = np.exp(1j * (headings[near] - yaws[near] - known[1]))
        off = float(np.angle(np.median(turned.real) + 1j * np.median(turned.imag)))
        if abs(off) > _OFF_RAD and np.median(np.abs(np.angle(turned * np.exp(-1j * off)))) < _HALF * abs(off):
            text = f"{f.topic}: its heading is {np.degrees(off):.0f} degrees off the course of the fixes (0 is east)"
            quarter = round(off / (0.5 * np.pi)) * 0.5 * np.pi
            off = quarter if abs(off - quarter) < _NEARLY_RAD else off
            turn = (0.0, 0.0, 0.0, 0.0, 0.0, np.sin(0.5 * off), np.cos(0.5 * off))
            settings = turned_mount(f.input, f.frame, f.T_base_frame, turn) if f.frame else ()
            at = where(f.topic, stamp_ns, settings=settings)
            yield Finding("heading_offset", "error", off, _OFF_RAD, "rad", text, **at)
