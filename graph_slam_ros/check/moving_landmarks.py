"""Landmarks that move: with the robot, by themselves, or all at once because their frame does not move with it."""

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from graph_slam_ros.check.columns import Columns, SightingColumns
from graph_slam_ros.check.pairs import HALF, Pairs, noise_of, pairs_of, poses_at
from graph_slam_ros.findings.finding import Finding
from graph_slam_ros.lie import se3
from graph_slam_ros.typing import Array, Index, Mask

_LEAST_PAIRS, _LEAST_NAMES = 10, 3  # of a landmark; landmarks of a fixed frame
_NOISES = 4.0  # by which a landmark moves on the ground; HALF of that on the robot that carries it
_MOST, _SOME = 0.8, 0.3  # part of the pairs of one landmark that moves; part of the landmarks that may
_TIMES, _NEARLY_ALL = 3.0, 0.9  # as far as this part of the others
_MOST_NAMED, _SAMPLED, _ABOUT_NS = 5, 60, 10_000_000_000  # findings; sightings about which, and for so long, one stays


@dataclass(frozen=True, slots=True, eq=False)
class LandmarkMotions:
    """The motion of each landmark within some seconds, by the medians of its pairs.

    Attributes
    ----------
    names : (n,) numbers of the identities that are seen often enough
    on_robot, on_ground : (n,) on the robot, and on the ground if odometry is right [m]
    at : (n, 3) where it is on the robot
    with_robot, by_itself : (n,) whether it stays at one place on the robot while that moves, or nowhere; those with
        wrong ids now and then stay most of the time
    noise_m : what two sightings of a landmark differ by, where nothing is wrong
    """

    names: Index
    on_robot: Array
    on_ground: Array
    at: Array
    with_robot: Mask
    by_itself: Mask
    noise_m: float


def motions_of(c: Columns, s: SightingColumns, pairs: Pairs) -> LandmarkMotions:
    """Return how each landmark moves, by odometry."""
    noise_m = noise_of(s, pairs)
    grounds = pairs.residuals(s.points)
    robots = np.linalg.norm((s.points[pairs.b] - s.points[pairs.a])[:, : pairs.dimensions], axis=1)
    of = s.name[pairs.a]
    names = np.flatnonzero(np.bincount(of, minlength=len(s.names)) >= _LEAST_PAIRS)
    chosen = [np.flatnonzero(of == name) for name in names]
    on_robot, on_ground = (np.array([np.median(some[k]) for k in chosen]) for some in (robots, grounds))
    poses = poses_at(np.clip(s.stamp_ns, c.path_ns[0], c.path_ns[-1]), c.path_ns, c.path)
    ground = np.stack(se3.act(tuple(poses.T), tuple(s.points.T)), axis=1)[:, : pairs.dimensions]
    moving = np.array([(grounds[k] > 2.0 * noise_m).mean() for k in chosen])
    at = np.array([np.median(s.points[pairs.a[k]], axis=0) for k in chosen]).reshape(-1, 3)
    staying = np.array([_staying(s.stamp_ns[s.name == k], ground[s.name == k], 2.0 * noise_m) for k in names])
    moves = (on_ground > _NOISES * noise_m) & (moving > _MOST)
    with_robot = moves & (on_robot < HALF * on_ground)
    by_itself = moves & ~with_robot & (staying < _SOME)
    return LandmarkMotions(names, on_robot, on_ground, at, with_robot, by_itself, noise_m)


def _staying(stamp_ns: Index, ground: Array, near_m: float) -> float:
    """The median part of the sightings about the time of one that are at its place."""
    parts = []
    for k in np.linspace(0, len(stamp_ns) - 1, min(_SAMPLED, len(stamp_ns))).astype(np.int64):
        about = np.abs(stamp_ns - stamp_ns[k]) < _ABOUT_NS
        parts.append(float((np.linalg.norm(ground[about] - ground[k], axis=1) < near_m).mean()))
    return float(np.median(parts))


def check_moving(s: SightingColumns, by: LandmarkMotions, count: int) -> Iterator[Finding]:
    """Sightings of a fixed frame, whatever frame they name, and landmarks that move, by this many pairs."""
    if np.count_nonzero(by.with_robot) >= max(_LEAST_NAMES, _MOST * len(by.names)):
        robot_m, ground_m = float(np.median(by.on_robot)), float(np.median(by.on_ground))
        text = f"while the robot drives, landmarks stay where they are on it to {robot_m:.2f} m, and would "
        text += f"move by {ground_m:.2f} m on the ground: they are given in a frame that does not move with the robot"
        times = ground_m / max(robot_m, 1e-9)
        yield s.finding("seen_in_fixed_frame", "error", times, 1.0 / HALF, "times", text, count)
        return
    for k in moving_alone(by)[:_MOST_NAMED]:
        name, own_ns = s.names[by.names[k]], np.sort(s.stamp_ns[s.name == by.names[k]])
        text = f"landmark {name} moves: it is {by.on_ground[k]:.2f} m from its place a few seconds later"
        text += ": do all have its id?" * (len(s.names) == 1)
        if by.with_robot[k]:
            place = f"at x {by.at[k, 0]:.2f} and y {by.at[k, 1]:.2f} m on it"
            text = f"landmark {name} moves along with the robot, {place}: a part of it, or a follower"
        yield s.finding("landmark_moves", "warning", by.on_ground[k], _NOISES * by.noise_m, "m", text, at=own_ns)


def moving_alone(by: LandmarkMotions) -> list[int]:
    """The landmarks that move where the others do not, by their place in the columns; the farthest first."""
    moves = by.with_robot | by.by_itself
    rest = by.on_ground[~moves]
    is_rest_moving = len(rest) and float(np.median(rest)) > 2.0 * by.noise_m
    if is_rest_moving or not moves.any() or moves.sum() > max(1.0, _SOME * len(moves)):
        return []
    least_m = _TIMES * float(np.quantile(rest, _NEARLY_ALL)) if len(rest) else 0.0  # odometry that is wrong moves all
    found = np.flatnonzero(moves & (by.on_ground > least_m))
    return [int(k) for k in found[np.argsort(-by.on_ground[found], kind="stable")]]


def moving_names(c: Columns) -> dict[str, set[str]]:
    """Identities that move, by their input."""
    found: dict[str, set[str]] = {}
    for s in c.sightings if len(c.path_ns) > 1 else ():
        pairs = pairs_of(c, s) if len(s.stamp_ns) else None
        if pairs is not None and len(pairs.a) >= _LEAST_PAIRS:
            by = motions_of(c, s, pairs)
            found[s.input] = {s.names[by.names[k]] for k in moving_alone(by)}
    return {name: names for name, names in found.items() if names}


def without(c: Columns, moving: Mapping[str, Collection[str]]) -> Columns:
    """The same recording without sightings of some identities, by their input."""
    kept = []
    for s in c.sightings:
        out = [k for k, name in enumerate(s.names) if name in moving.get(s.input, ())]
        kept.append(s.some(~np.isin(s.name, out)) if out else s)
    return replace(c, sightings=tuple(kept))
