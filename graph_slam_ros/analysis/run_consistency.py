"""The consistency of a saved run: the NEES of its poses and landmarks, and the noise that it found.

Errors are seen from the first keyframe with a true pose. Where the truth is positions only, those of the plane are seen
from the line between two of them: the first, and the one that is farthest from it.
"""

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from graph_slam_ros.analysis.consistency import Consistency, Nees, landmark_errors, noise_advice, pose_errors
from graph_slam_ros.analysis.path_error import interpolated
from graph_slam_ros.analysis.trajectories import Truth
from graph_slam_ros.analysis.what_if import SavedGraph
from graph_slam_ros.errors import GraphSlamError, message_of
from graph_slam_ros.runs import outcome
from graph_slam_ros.runs.folder import COVARIANCES, SUMMARY, run_config, summary_of
from graph_slam_ros.runs.trajectory import LandmarkTable, Trajectory, read_covariances, read_landmarks, read_rows
from graph_slam_ros.slam.noise.scale import NoiseScale
from graph_slam_ros.slam.weak_direction import position_covariance
from graph_slam_ros.typing import Array

_MOST = 500  # poses for which joint covariances are computed
_All = tuple[Nees | None, Nees | None, Nees | None]  # of the last pose, of poses, of landmarks


def line_covariances(saved: SavedGraph, line: tuple[int, int], vertices: Sequence[int | None]) -> Array:
    """Covariances (n, 2, 2) of positions in the axes of map, seen from the line between those of two keyframes.

    What a position has in common with the line is no error as seen from there. NaN where there is no vertex.
    """
    ends, space, out = [saved.vertices[k] for k in line], saved.space, np.full((len(vertices), 2, 2), np.nan)

    def value(vertex: int) -> Array:
        return np.asarray(saved.solver.estimate([vertex])[0])

    def by_position(pose: Array) -> Array:
        """The Jacobian of a position by the tangent space of its vertex."""
        return np.eye(2) if len(pose) == 2 else np.hstack([space.turn(tuple(pose)), np.zeros((2, space.dof - 2))])

    def across(arm: Array) -> Array:
        return np.array([-arm[1], arm[0]])

    first, last = map(value, ends)
    along = (last - first)[:2]
    for k, vertex in enumerate(vertices):
        if vertex in ends:
            out[k] = 0.0
        elif vertex is not None:
            point = value(vertex)
            turned = np.outer(across(point[:2] - first[:2]), across(along)) / (along @ along)
            of_ends = (turned - np.eye(2)) @ by_position(first), -turned @ by_position(last)
            jacobian = np.hstack([*of_ends, by_position(point)])
            out[k] = jacobian @ saved.solver.joint_marginal([*ends, vertex]) @ jacobian.T
    return out


def consistency_of(run: Path, known: Truth, keyframes: slice, *, is_first: bool) -> Consistency | None:
    """Return the consistency of a drive of a run; None if it has no covariances.

    Parameters
    ----------
    keyframes : of the drive
    is_first : whether the map began with this drive
    """
    if not os.path.lexists(run / COVARIANCES):
        return None
    path, covariances = read_rows(run / "path.tum"), read_covariances(run / COVARIANCES)
    if len(covariances) != len(path.stamps_s):
        raise GraphSlamError(f"{run / COVARIANCES}: {len(covariances)} rows for {len(path.stamps_s)} poses of path.tum")
    path, covariances = path.at(keyframes), covariances[keyframes]
    is_planar = covariances.shape[1] == 3
    true = interpolated(known.trajectory.in_plane() if is_planar else known.trajectory, path.stamps_s)
    is_held, noise = _noise(run)
    config = run_config(run)
    is_applied = config.robust.noise_scale == "estimated"
    reason = _why_no_nees(known, true, is_first=is_first, is_held=is_held, is_planar=is_planar)
    if reason:
        found = Consistency(None, None, None, noise, {"poses and landmarks": reason})
    else:
        landmarks = read_landmarks(run / "landmarks.csv")
        drive, frame = _Compared(run, path, true, landmarks, known), ""
        if not known.trajectory.has_orientation:
            several, frame = drive.positions()
        elif np.isfinite(true[0]).all() and np.isfinite(covariances[0]).all():  # that of a condensed one is not known
            several = drive.poses(0, covariances, landmarks.covariances)
        else:
            several, frame = drive.later()
        found = Consistency(*several, noise, _left_out(*several, known, len(landmarks)), frame=frame)
    is_void = any(one.severity == "error" for one in outcome.findings(summary_of(run)))
    config_of = None if is_void else config  # such a run says nothing of odometry's noise
    advice = noise_advice(noise, is_applied=is_applied, config=config_of, over_confident=found.over_confidence)
    return replace(found, advice=advice)


class _Compared:
    """A drive and its truth, in the frames that they can be compared in."""

    def __init__(self, run: Path, path: Trajectory, true: Array, landmarks: LandmarkTable, known: Truth) -> None:
        self._run, self._path, self._true, self._names = run, path, true, landmarks.names
        unknown = (np.nan, np.nan, np.nan)
        self._places = landmarks.positions
        self._true_places = np.array([known.landmarks.get(name, unknown) for name in self._names]).reshape(-1, 3)
        self._with_truth = np.flatnonzero(np.isfinite(true).all(axis=1))

    def poses(self, first: int, covariances: Array, spreads: Array) -> _All:
        """NEES seen from a pose whose covariance all others contain; ``covariances`` begin there."""
        estimate, true = self._path.poses[first:], self._true[first:]
        errors, relative = pose_errors(estimate, true, covariances)
        seen = landmark_errors(self._places, self._true_places, spreads, estimate[0], true[0], covariances[0])
        return Nees.of(errors[-1:], relative[-1:]), Nees.of(errors, relative), Nees.of(*seen)

    def later(self) -> tuple[_All, str]:
        """NEES seen from the first keyframe with truth, where that is not the first: it alone holds the map then."""
        saved = self._saved()
        first, space = int(self._with_truth[0]), saved.space
        solver = saved.problem([e.edge for e in saved.entries if e.is_in and len(e.vertices) == 1])
        solver.hold(saved.vertices[first])
        solver.optimize()
        known = [k for k in saved.numbers if first <= k < len(self._true)]
        covariances = np.full((len(self._true) - first, space.dof, space.dof), np.nan)
        covariances[np.array(known) - first] = solver.marginal([saved.vertices[k] for k in known])
        spreads = np.full((len(self._names), 3, 3), np.nan)
        for spread, name in zip(spreads, self._names, strict=True):
            if (vertex := saved.landmarks.get(name)) is not None:
                value, n = tuple(solver.estimate([vertex])[0].tolist()), space.dimensions
                spread[:n, :n] = position_covariance(space, value, solver.marginal([vertex])[0])
                spread[n:], spread[:, n:] = 0.0, 0.0
        found = self.poses(first, covariances, spreads)
        return found, f"seen from keyframe {first}, the first in the graph with a true pose"

    def positions(self) -> tuple[_All, str]:
        """NEES of positions in the plane, seen from the line between two of them."""
        path, true = self._path.poses[:, :2], self._true[:, :2]
        saved = self._saved()
        first, some = int(self._with_truth[0]), self._some()
        last = int(some[np.argmax(np.linalg.norm(true[some] - true[first], axis=1))])
        line, true_line = path[last] - path[first], true[last] - true[first]
        angle = np.arctan2(line[1], line[0]) - np.arctan2(true_line[1], true_line[0])
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])

        def errors(estimate: Array, truth: Array) -> Array:
            return path[first] + (truth[:, :2] - true[first]) @ turn.T - estimate[:, :2]

        some = some[some != first]
        off = errors(path[some], true[some])
        covariances = line_covariances(saved, (first, last), [saved.vertices[k] for k in some])
        of_landmarks = line_covariances(saved, (first, last), [saved.landmarks.get(name) for name in self._names])
        seen = Nees.of(errors(self._places, self._true_places), of_landmarks)
        found = Nees.of(off[-1:], covariances[-1:]), Nees.of(off, covariances), seen
        text = f"of positions, seen from the line between keyframes {first} and {last}: the truth has no heading"
        return found, text

    def _saved(self) -> SavedGraph:
        """Return the graph of the run; from now on only keyframes that are in it count."""
        saved = SavedGraph(self._run, [])
        self._with_truth = np.intersect1d(self._with_truth, saved.numbers)
        if not len(self._with_truth):
            raise GraphSlamError(f"{self._run}: no keyframe with a truth is in the graph: visits were condensed")
        return saved

    def _some(self) -> Array:
        """The keyframes with truth, at most so many as are computed, the first and last among them."""
        known = self._with_truth
        return known[np.unique(np.linspace(0, len(known) - 1, min(_MOST, len(known))).astype(int))]


def _why_no_nees(known: Truth, true: Array, *, is_first: bool, is_held: bool, is_planar: bool) -> str:
    """Return why errors and covariances cannot be compared; empty if they can."""
    if is_held:
        return "fixes hold the map, not its first pose, and how their frame lies in that of the truth is not known"
    if not is_first:
        return "the map was there before the drive, so the first pose of the drive does not hold it"
    if np.count_nonzero(np.isfinite(true).all(axis=1)) < 2:
        return "fewer than two keyframes have a truth within 0.05 s"
    if not (known.trajectory.has_orientation or is_planar):
        return f"{known.source} has no orientation, which says how the map lies in its frame"
    return ""


def _left_out(
    last: Nees | None, poses: Nees | None, of_landmarks: Nees | None, known: Truth, landmarks: int
) -> dict[str, str]:
    out = {}
    if poses is None:
        out["poses"] = "none but the first has a truth within 0.05 s and a covariance"
    elif last is None:
        out["last pose"] = "it has no truth within 0.05 s, or no covariance"
    if of_landmarks is None and landmarks:
        why = "none of them has a covariance and is among the true ones"
        out["landmarks"] = why if known.landmarks else "the truth has none (/landmarks_ground_truth)"
    return out


def _noise(run: Path) -> tuple[bool, tuple[NoiseScale, ...]]:
    """Return whether fixes or surveyed landmarks hold the map, and the noise estimated, by the summary of a run."""
    try:
        summary = summary_of(run)
        is_held = bool({"fixes", "surveyed"} & set(summary["classes"]))
        return is_held, tuple(NoiseScale.from_dict(one) for one in summary.get("noise", ()))
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        why = f"not a summary of a run ({message_of(error)}): graph_slam replay {run} --out NEW makes one"
        raise GraphSlamError(f"{run / SUMMARY}: {why}") from None
