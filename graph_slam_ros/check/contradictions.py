"""Checks of sightings against odometry without a fit: the same landmark, seen twice within a few seconds."""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from operator import itemgetter

import numpy as np

from graph_slam_ros.check.columns import MOST, Columns, SightingColumns
from graph_slam_ros.check.moving_landmarks import check_moving, motions_of
from graph_slam_ros.check.odometry import fitted, twist_factor
from graph_slam_ros.check.pairs import (
    HALF,
    LATER_S,
    LEAST_TURNED,
    TURNED_RAD,
    Pairs,
    check_bearings,
    check_noise,
    check_ranges,
    noise_of,
    noisier,
    pairs_of,
)
from graph_slam_ros.findings.finding import Finding, Severity
from graph_slam_ros.findings.table import NO_IDS
from graph_slam_ros.formats.parameters import assignment
from graph_slam_ros.lie import se3, so3
from graph_slam_ros.typing import Array, Index, Mask

# In brackets: by how much less and more the findings of 255 recordings are the same, faults and robots among them.
_LEAST_PAIRS = 30  # (x 0.1, x 1)
_FAR_M = 200.0  # the farthest of tags, cones and poles that a robot sees (x 0.1, x 8)
_FIFTH = 0.2  # of the residuals: another explanation is right, whatever the noise (x 0.1, x 2)
_NOISES, _NEAR_M = 2.0, 0.3  # residuals that need no other explanation: times noise, whatever it is (x 0.5, x 8)
_NEARLY, _RELATED = 1.2, 0.7  # times the best of others (x 1, x 8), or of chance (x 1, x 1): no better
_UNRELATED, _UNRELATED_NOISES, _UNRELATED_PAIRS = 0.6, 4.0, 100  # part (x 1, x 1), times noise, pairs (x 0.1, x 2)
_TWICE, _NO_IDS = 0.002, 0.2  # part of the sightings: ids that are there twice (x 0.1, x 2), and are none (x 1, x 8)
_SELDOM = 3  # sightings of an id (x 1, x 1)
_AGAIN_S, _AGAIN_M, _SPAN = 10.0, 3.0, 0.25  # comes back (x 0.1, x 8), (x 0.1, x 2); is to span, of a drive (x 1, x 1)
_CHANCE, _MOST_BY_CHANCE = 0.02, 2  # part of the landmarks, and of many: all ids change, but these
_LOOP = 0.1  # of the way: landmarks that come back within less close no loop of the drive
_QUARTER = 0.5**0.5
_CORRECTED = "_corrected"
_SIGMAS, _OTHER_SCALE, _LEAST_SCALE = 4.0, 0.15, 0.1  # a fit finds less than _OTHER_SCALE
_FIXED = 20.0  # sigmas, or metres, that fixes are apart
_PLACE_M = 0.03  # by which the place of a sensor may be wrong

_OPTICAL = "those of an optical frame (z ahead, x to the right)"
# Where a sensor would be turned on the robot, if its positions are in other axes: R_frame_true.
TURNS: Mapping[str, so3.Quaternion] = {
    "turned by 90 degrees": (0.0, 0.0, _QUARTER, _QUARTER),
    "turned by -90 degrees": (0.0, 0.0, -_QUARTER, _QUARTER),
    "turned by 180 degrees": (0.0, 0.0, 1.0, 0.0),
    _OPTICAL: (-0.5, 0.5, -0.5, 0.5),
}
EXCHANGED, MIRRORED = "x and y exchanged", "y to the right"
_AHEAD, _INVERTED = "those of the robot (x ahead)", "those of its transform the other way round"


def check_contradictions(c: Columns) -> Iterator[Finding]:
    """Each input of landmarks against odometry: units, axes, mirrors, identities, and what is seen again."""
    for s in c.sightings if len(c.path_ns) > 1 else ():
        yield from (twice := list(_identities(c, s)))
        if not len(s.stamp_ns) or any(one.severity == "error" for one in twice):
            continue
        found = list(check_ranges(c, s))
        if c.config.world.dimensions == 2:
            found += check_bearings(c, s)
        found += [*check_noise(c, s), *_contradictions(c, s)]
        yield from found
        if not any(one.ends for one in found):
            yield from _coverage(s, c.path_ns, c.path)


def _contradictions(c: Columns, s: SightingColumns) -> Iterator[Finding]:
    """Yield the findings of the first check that has any: they make all later ones meaningless."""
    use = s.located(c.path_ns)
    if not use.any():
        return
    distance_m = np.linalg.norm(s.points, axis=1)
    far_m = float(np.median(distance_m[use]))
    if far_m > _FAR_M:
        text = f"the median distance of landmarks is {far_m:.0f} m: are these metres?"
        yield s.finding("units", "error", far_m, _FAR_M, "m", text, use.sum())
        return
    pairs = pairs_of(c, s)
    if len(pairs.a) < _LEAST_PAIRS:
        text = f"landmarks are seen again within {LATER_S:.0f} s of motion only {len(pairs.a)} times"
        yield s.finding("no_parallax", "note", len(pairs.a), _LEAST_PAIRS, "pairs", text, use.sum())
        return
    noise_m, count = noise_of(s, pairs), len(pairs.a)
    found = _mirrored(c, s, pairs, noise_m) or _axes(s, pairs, noise_m, use) or _scaled(c, s, pairs)
    along = [] if found is not None else list(check_moving(s, motions_of(c, s, pairs), count))
    yield from along
    if any(one.ends for one in along):
        return
    if noises := [found] if found is not None else list(check_noise(c, s, pairs)):
        yield from noises
        return
    residual_m = pairs.apart_m(s.points)
    lever_m = np.linalg.norm(pairs.motion[:, :3], axis=1) + pairs.turned * np.minimum(distance_m[pairs.a], 1e3)
    share = residual_m / float(np.median(lever_m))
    if share > _UNRELATED and residual_m > _UNRELATED_NOISES * noise_m and count > _UNRELATED_PAIRS:
        if residual_m < _RELATED * _of_others(s.points, pairs, use):
            yield from noisier(s, pairs)
            return
        text = f"odometry does not explain {share:.0%} of the motion between two sightings of a landmark"
        yield s.finding("unrelated", "error", share, _UNRELATED, "part", text, count)


def _of_others(points: Array, pairs: Pairs, use: Mask) -> float:
    """The median distance between two landmarks, whatever their identities: what chance would give."""
    chosen = np.flatnonzero(use)
    shifted = np.roll(chosen, len(chosen) // 2)[np.searchsorted(chosen, pairs.b)]
    return replace(pairs, b=shifted).apart_m(points)


def _explains(if_so_m: float, now_m: float, noise_m: float) -> bool:
    """Return whether sightings agree so much better that noise is no cause, even one that is stated too large."""
    return if_so_m < _FIFTH * now_m or (if_so_m < HALF * now_m and now_m > _NOISES * noise_m)


def _mounts(s: SightingColumns) -> dict[str, se3.Pose]:
    """Where the sensor would be on the robot, if its axes or its transform were others."""
    T = tuple(s.T_base_frame)
    found = {what: se3.compose(T, (0.0, 0.0, 0.0, *q)) for what, q in TURNS.items()}
    return found | {_AHEAD: (*T[:3], *se3.rotation(se3.IDENTITY)), _INVERTED: se3.inverse(T)}


def _placed(s: SightingColumns, T_base_true: se3.Pose) -> Array:
    """Points (k, 3) in the base frame, if the sensor were there."""
    T = se3.compose(T_base_true, se3.inverse(tuple(s.T_base_frame)))
    return np.stack(se3.act(T, tuple(s.points.T)), axis=1)


def _hypotheses(s: SightingColumns) -> dict[str, Array]:
    """Points (k, 3) in the base frame, if those of the sensor are in other axes."""
    T = tuple(s.T_base_frame)
    seen = np.stack(se3.act(se3.inverse(T), tuple(s.points.T)), axis=1)
    others = {EXCHANGED: seen[:, [1, 0, 2]], MIRRORED: seen * [1.0, -1.0, 1.0]}
    turned = {what: _placed(s, there) for what, there in _mounts(s).items()}
    return turned | {what: np.stack(se3.act(T, tuple(points.T)), axis=1) for what, points in others.items()}


def _turned(s: SightingColumns, pairs: Pairs, T_base_true: se3.Pose) -> se3.Pose:
    """Turn and shift a sensor in the plane so that its sightings agree with odometry best.

    As complex numbers, with the motion (r, t) of the robot: z (a - r b) + (1 - r) d = t.
    """
    points, motion = _placed(s, T_base_true), pairs.motion
    a, b = (points[k, 0] + 1j * points[k, 1] for k in (pairs.a, pairs.b))
    t, r = motion[:, 0] + 1j * motion[:, 1], np.nan_to_num(np.exp(1j * so3.log(tuple(motion[:, 3:].T))[2]))
    (z, d), _ = fitted(np.stack([a - r * b, 1.0 - r], axis=1), t)
    turn = 0.5 * np.angle(z)
    return se3.compose((d.real, d.imag, 0.0, 0.0, 0.0, np.sin(turn), np.cos(turn)), T_base_true)


def _mirrored(c: Columns, s: SightingColumns, pairs: Pairs, noise_m: float) -> Finding | None:
    """A mirror shows only where the robot turns."""
    turns = pairs.turned > TURNED_RAD
    if turns.sum() < LEAST_TURNED:
        return None
    turning = pairs.some(turns)
    if (now_m := turning.apart_m(s.points)) <= min(_NOISES * noise_m, _NEAR_M):
        return None
    others = {what: turning.apart_m(points) for what, points in _hypotheses(s).items()}
    right = f"y or bearings count to the right, or if {c.odometry.topic} turns the other way"
    mirrors = {right: others.pop(MIRRORED)}
    if c.config.world.dimensions == 2:
        back = turning.motion * [1.0, -1.0, 1.0, 1.0, 1.0, -1.0, 1.0]  # odometry that turns the other way
        mirrors[right] = min(mirrors[right], turning.apart_m(s.points, back))
        moved = pairs_of(replace(c, path=c.path * [1.0, -1.0, *np.ones(5)]), s).motion[turns]
        what = f"x or y of the position of {c.odometry.topic} is mirrored, and its turns are right"
        mirrors[what] = turning.apart_m(s.points, moved)
    what, mirror_m = min(mirrors.items(), key=itemgetter(1))
    if not _explains(mirror_m, now_m, noise_m) or mirror_m >= _NEARLY * min(others.values()):
        return None
    apart = f"two sightings of a landmark differ by {now_m:.2f} m, but by {mirror_m:.2f} m"
    text = f"in turns, {apart} if {what}"
    return s.finding("mirrored", "error", now_m / max(mirror_m, 1e-9), 1.0 / HALF, "times", text, len(pairs.a))


def _axes(s: SightingColumns, pairs: Pairs, noise_m: float, use: Mask) -> Finding | None:
    if (now_m := pairs.apart_m(s.points)) <= min(_NOISES * noise_m, _NEAR_M):
        return None
    points, mounts, turning = _hypotheses(s), _mounts(s), pairs.some(pairs.turned > TURNED_RAD)
    del points[MIRRORED]
    both = (pairs, turning) if len(turning.a) >= LEAST_TURNED else (pairs,)  # along a line another fits, too
    left = {what: max(some.apart_m(there) for some in both) for what, there in points.items()}
    if pairs.dimensions == 2 and len(both) > 1:
        starts = {"turned": tuple(s.T_base_frame), **{what: mounts[what] for what in (_AHEAD, _OPTICAL)}}
        for axes, start in starts.items():
            mount = _turned(s, pairs, start)
            what = f"{axes}, and the sensor is at x {mount[0]:.2f}, y {mount[1]:.2f} m"
            points[what], mounts[what] = _placed(s, mount), mount
            left[what] = _NEARLY * max(some.apart_m(points[what]) for some in both)
    what = min(left, key=lambda one: left[one])
    if not _explains(left[what], now_m, noise_m) or left[what] >= _RELATED * _of_others(points[what], pairs, use):
        return None  # in the plane some axes hide any distance
    best_m = pairs.apart_m(points[what])
    apart = f"two sightings of a landmark differ by {now_m:.2f} m, but by {best_m:.2f} m"
    text = f"{apart} if the axes are {what}"
    is_all = best_m < _NOISES * noise_m  # else another mount is right
    settings = turned_mount(s.input, s.frame, mounts[what], se3.IDENTITY) if is_all and what in mounts else ()
    value = now_m / max(best_m, 1e-9)
    return s.finding("axes", "error", value, 1.0 / HALF, "times", text, len(pairs.a), settings=settings)


def _scaled(c: Columns, s: SightingColumns, pairs: Pairs) -> Finding | None:
    """Ranges by which two sightings of a landmark agree with odometry only if all are multiplied by one factor.

    Fixes tell which of them is wrong, or where the robot turns the place of the sensor on it, which neither measures.
    """
    n, rotation = pairs.dimensions, tuple(pairs.motion[:, 3:].T)
    origin = np.broadcast_to(np.array(s.T_base_frame[:3]), (len(pairs.a), 3))
    after, sensor = (np.stack(so3.act(rotation, tuple(points.T)), axis=1) for points in (s.points[pairs.b], origin))
    moved, turned = pairs.motion[:, :n], (sensor - origin)[:, :n]
    x = (s.points[pairs.a] - after)[:, :n] + turned
    (drive, swing), sigma = fitted(np.stack([moved.ravel(), turned.ravel()], axis=1), x.ravel())
    left, size = (np.median(np.linalg.norm(some, axis=1)) for some in (x - drive * moved - swing * turned, x))
    if len(s.names) == 1 or left > HALF * size or drive <= 0.0 or abs(drive - 1.0) < _OTHER_SCALE:
        return None
    doubt = _SIGMAS * sigma + _PLACE_M / max(float(np.hypot(*s.T_base_frame[:2])), 1e-9)
    if any(len(f.points) and np.abs(f.points - f.points[0]).max() > _FIXED * max(f.sigma_m, 1.0) for f in c.fixes):
        swing, doubt = drive, 0.0  # which agree with odometry: else nothing was asked of landmarks
    of_odometry, of_ranges = abs(swing - 1.0), abs(swing - drive)  # the place of the sensor is in metres
    is_told = min(of_odometry, of_ranges) + doubt < HALF * max(of_odometry, of_ranges)
    now = next((one.range_factor for one in c.config.sources if one.name == s.input), 1.0)
    scale, o = c.config.odometry.distance_factor, c.odometry
    by_ranges = factor_setting(f"{s.input}.range_factor", now / drive, 10.0)
    by_odometry = factor_setting("odometry.distance_factor", scale * drive, 100.0)
    is_twist = abs(scale * twist_factor(o) * drive - 1.0) < _OTHER_SCALE
    if is_twist or drive < _LEAST_SCALE or (is_told and of_odometry < of_ranges):
        text = f"its pose moves {1.0 / drive:.3g} times as far as landmarks say: is it in metres?"
        return o.finding("units", "error", 1.0 / drive, 1.0 + _OTHER_SCALE, "times", text, settings=by_odometry)
    text = f"ranges are {drive:.2f} times as long as odometry says: is the tags' size right (black square)?"
    if not is_told and by_ranges and by_odometry:
        text += f" If the ranges are wrong: {by_ranges[0]}; if odometry is: {by_odometry[0]}"
    settings, limit = by_ranges if is_told else (), 1.0 + _OTHER_SCALE
    return s.finding("range_scale", "error", drive, limit, "times", text, len(pairs.a), settings=settings)


def factor_setting(key: str, factor: float, most: float) -> tuple[str, ...]:
    """Return the setting of a factor, or none where it is beyond the limits of the parameter, 1 / most to most."""
    return (assignment(key, float(f"{factor:.4g}")),) if 1.0 / most <= factor <= most else ()


def turned_mount(name: str, frame: str, T_base_frame: se3.Pose, T_frame_true: se3.Pose) -> tuple[str, ...]:
    """Settings that place an input's sensor elsewhere than its frame is, by a frame of its own name."""
    T = se3.compose(tuple(T_base_frame), T_frame_true)
    numbers = " ".join(f"{0.0 if abs(x) < 5e-7 else x:.6g}" for x in (*T[:3], *_rpy(tuple(T[3:]))))
    corrected = frame if frame.endswith(_CORRECTED) else f"{frame or 'sensor'}{_CORRECTED}"
    return assignment(f"{name}.frame", corrected), assignment(f"{name}.mount", numbers)


def _rpy(q: so3.Quaternion) -> tuple[float, float, float]:
    """Roll, pitch and yaw about fixed axes, as ``se3.from_xyz_rpy`` takes them."""
    R = so3.matrix(q)
    pitch = float(np.arcsin(np.clip(-R[2, 0], -1.0, 1.0)))
    if abs(R[2, 0]) > 1.0 - 1e-9:  # only the sum of the others is determined
        return 0.0, pitch, float(np.arctan2(-R[0, 1], R[1, 1]))
    return float(np.arctan2(R[2, 1], R[2, 2])), pitch, float(np.arctan2(R[1, 0], R[0, 0]))


def _identities(c: Columns, s: SightingColumns) -> Iterator[Finding]:
    conflicts = c.counters[s.input, "id_conflict"]  # places differ; those of a tag in two cameras agree, and are merged
    twice = c.counters[s.input, "id_merged"] + conflicts
    if (share := twice / max(len(s.stamp_ns) + twice, 1)) > _TWICE:
        severity: Severity = "error" if share * conflicts / twice > _NO_IDS else "warning"
        text = f"{share:.1%} of the sightings have an id that is twice in their message"
        settings = NO_IDS if severity == "error" else ()
        yield s.finding("id_twice", severity, share, _TWICE, "part", text, twice, settings=settings)


def _coverage(s: SightingColumns, path_ns: Index, path: Array) -> Iterator[Finding]:
    inside = (s.stamp_ns >= path_ns[0]) & (s.stamp_ns <= path_ns[-1])
    between = np.diff([0, *np.searchsorted(path_ns, np.sort(s.stamp_ns[inside])), len(path_ns)])
    silent = float(between.max()) / len(path_ns)
    if silent > MOST:
        text = f"nothing is seen for {silent:.0%} of the drive, for {int(between.max())} poses of odometry"
        yield s.finding("silent", "warning", silent, MOST, "part", text)
    chosen = np.flatnonzero(s.named(path_ns))
    if not len(chosen):
        return
    order = chosen[np.lexsort((s.stamp_ns[chosen], s.name[chosen]))]
    is_same = np.diff(s.name[order]) == 0
    first, last = (np.flatnonzero(np.concatenate(ends)) for ends in (([True], ~is_same), (~is_same, [True])))
    seldom = float((last - first + 1 < _SELDOM).mean())
    if seldom > MOST:
        text = f"{seldom:.0%} of {len(first)} ids are seen less than {_SELDOM} times"
        yield s.finding("seen_once", "warning", seldom, MOST, "part", text)
    driven = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path[:, :3], axis=0), axis=1))])
    seconds, at_s = ((stamp_ns - path_ns[0]) * 1e-9 for stamp_ns in (path_ns, s.stamp_ns[order]))
    at_m = np.interp(at_s, seconds, driven)
    comes_back = (is_same & (np.diff(at_s) > _AGAIN_S) & (np.diff(at_m) > _AGAIN_M)).any()
    few = min(int(_CHANCE * len(first)), _MOST_BY_CHANCE)  # where all ids change now and then, some come back before
    reach_m = float(np.sort(at_m[last] - at_m[first])[-1 - few])
    least_m = float((_LOOP if comes_back else _SPAN) * driven[-1])
    if reach_m < least_m and driven[-1] > _AGAIN_M:
        again = "nothing joins its parts that are farther apart" if comes_back else "no landmark is seen again later"
        each = f"each landmark but {few}" if few else "each landmark"
        text = f"{each} is seen over at most {reach_m:.1f} of {driven[-1]:.0f} m: {again}"
        yield s.finding("no_closure", "warning", reach_m, least_m, "m", text)
