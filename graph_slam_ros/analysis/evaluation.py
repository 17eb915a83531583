"""Evaluation of a run against the truth: errors of position, orientation, drift and map, and consistency.

For the errors, the estimate is aligned to the truth by the rigid motion that fits best, without scale. The motion is in
the plane or in space, as the run is. Poses are compared if their stamps differ by at most 0.05 s. Consistency is
computed in the frame of a pose.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from graph_slam_ros.analysis.consistency import Consistency, consistency_of
from graph_slam_ros.analysis.path_error import (
    STATISTICS,
    Drift,
    PathError,
    Statistics,
    alignment,
    associate,
    matched,
    path_error,
)
from graph_slam_ros.analysis.trajectories import Truth, read_truth
from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.formats.files import is_empty
from graph_slam_ros.lie import se3
from graph_slam_ros.runs.folder import is_recording, is_run, run_config, summary_of
from graph_slam_ros.runs.trajectory import Point, Trajectory, read_landmarks, read_rows
from graph_slam_ros.typing import Array

_KEYFRAMES = ("path.tum", "path_odometry.tum")  # estimate and dead reckoning
_SIGHTINGS = ("sightings.tum", "odometry.tum")
_FAR, _FAR_M = 0.5, 0.3  # an error larger than this part of the true path, and than that, is not one of a good map
_MOST_LATE_S, _LATE_S, _LATE_M, _CLEARLY = 20.0, 0.1, 0.1, 0.4
_MOST_POSES, _OVERLAP = 500, 0.8  # of hundreds of alignments; part of these that is not lost where stamps move
_ONE_DRIVE = [{"keyframe": 0, "sighting": 0}]


@dataclass(frozen=True, slots=True)
class Scores:
    """Errors of a run.

    Attributes
    ----------
    estimate : errors of the estimate
    odometry : errors of dead reckoning; None if the run has none
    map_rmse_m : RMSE of landmarks with the same id, aligned separately; None with too few landmarks or without truth
    consistency : of the run; None if it has no covariances
    dimensions : 2 or 3
    losses : what could not be read of the truth
    warnings : reasons why the errors may be misleading
    scored : what was compared with what, in words
    """

    estimate: PathError
    odometry: PathError | None
    map_rmse_m: float | None
    consistency: Consistency | None = None
    dimensions: int = 2
    losses: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    scored: dict[str, str] = field(default_factory=dict)

    @property
    def _angle(self) -> str:
        return "heading" if self.dimensions == 2 else "angle"

    def as_dict(self) -> dict[str, Any]:
        """Plain values; missing ones are None. Angles are ``heading_rad`` in the plane, ``angle_rad`` in space."""

        def drift(one: Drift | None, unit: str) -> dict[str, Any] | None:
            angle = f"{self._angle}_rad_per_{unit}"
            return None if one is None else {f"position_m_per_{unit}": one.position, angle: one.angle, "n": one.n}

        def plain(error: PathError) -> dict[str, Any]:
            return {
                "position_m": error.position_m,
                f"{self._angle}_rad": error.angle_rad,
                "drift": {"per_s": drift(error.per_s, "s"), "per_m": drift(error.per_m, "m")},
                "n": error.n,
                "of": error.of,
            }

        return plain(self.estimate) | {
            "map_m": None if self.map_rmse_m is None else {"rmse": self.map_rmse_m},
            "odometry": self.odometry and plain(self.odometry),
            "consistency": self.consistency and self.consistency.as_dict(),
            "scored": self.scored,
        }

    def __str__(self) -> str:
        lines = [f"{name:30s}{what}" for name, what in self.scored.items()]
        title = f"error at {self.estimate.n} of {self.estimate.of} stamps"
        lines.append(f"{title:30s}{'rmse':>10s}{'median':>10s}{'max':>10s}")
        for name, error in (("estimate", self.estimate), ("dead reckoning", self.odometry)):
            if error is not None:
                lines += self._rows(name, error)
        if self.map_rmse_m is not None:
            lines.append(f"{'landmarks, position [m]':30s}{self.map_rmse_m:10.3f}")
        if self.consistency is not None:
            lines.append(str(self.consistency))
        return "\n".join(lines)

    def _rows(self, name: str, error: PathError) -> list[str]:
        degrees = 180.0 / np.pi
        rows = [
            (f"{name}, position [m]", error.position_m, 1.0, 3),
            (f"{name}, {self._angle} [deg]", error.angle_rad, degrees, 2),
        ]
        for one, unit in ((error.per_s, "s"), (error.per_m, "m")):
            if one is not None:
                rows.append((f"{name}, drift [m/{unit}]", one.position, 1.0, 4))
                rows.append((f"{name}, drift [deg/{unit}]", one.angle, degrees, 3))
        return [_line(*row) for row in rows if row[1] is not None]  # type: ignore[arg-type]


def _line(name: str, values: Statistics, factor: float, digits: int) -> str:
    return f"{name:30s}" + "".join(f"{factor * values[key]:10.{digits}f}" for key in STATISTICS)


@dataclass(frozen=True, slots=True)
class Drive:
    """The part of a run that is evaluated: the paths of one drive.

    Attributes
    ----------
    estimate, odometry : the paths; odometry is None if there is none
    names : the names of their files
    keyframes : its rows in ``path.tum``
    number, count : number of the drive, from 1, and number of drives; the others were in the loaded map
    """

    estimate: Trajectory
    odometry: Trajectory | None
    names: tuple[str, str]
    keyframes: slice
    number: int = 1
    count: int = 1


def evaluate(
    run: Path | str, truth: Truth | str | Path, estimate: str = "", topic: str = "", *, align: bool = True
) -> Scores:
    """Compare a run's folder with the truth.

    Parameters
    ----------
    run : the run folder
    truth : ``BAG``, ``BAG:TOPIC`` or ``FILE.tum``, or the result of ``read_truth``
    estimate : file of the path to evaluate; default: ``sightings.tum``, or ``path.tum`` without observations
    topic : topic of the truth, as in ``read_truth``
    align : align the run to the truth; False: the map is already in the frame of the truth

    Raises GraphSlamError: a file or topic that is missing or unreadable, or too few common stamps.
    """
    run = Path(run)
    if is_recording(run):
        run_config(run)  # it is refused as such
    inputs = input_topics(run)
    known = truth if isinstance(truth, Truth) else read_truth(truth, topic, inputs)
    dimensions = dimensions_of(run)
    drive = scored_drive(run, known.trajectory, estimate)
    landmarks = read_landmarks(run / "landmarks.csv")
    scored = {"truth": known.source, "estimate": _described(drive)}
    scored["frame"] = "aligned to the truth" if align else "not aligned to the truth"
    warnings = [known.doubt] if known.doubt else []
    if known.topic in inputs:
        warnings.append(f"{known.topic} was an input of the run: the error says how well it fits, not how true it is")
    odometry, error = drive.odometry, path_error(drive.estimate, known.trajectory, dimensions, align=align)
    warnings += _doubts(drive.estimate, known.trajectory, error, dimensions, align=align)
    return Scores(
        error,
        None if odometry is None else path_error(odometry, known.trajectory, dimensions),
        _map_rmse(dict(zip(landmarks.names, landmarks.positions, strict=True)), known.landmarks, dimensions),
        consistency_of(run, known, drive.keyframes, is_first=drive.number == 1),
        dimensions,
        known.losses,
        tuple(warnings),
        scored,
    )


def dimensions_of(run: Path) -> int:
    """The dimensions of a run's world; 2 if the folder is not a run."""
    return run_config(run).world.dimensions if is_run(run) else 2


def input_topics(run: Path) -> set[str]:
    """The topics of the inputs in the configuration of a run."""
    return {f"/{one.topic.lstrip('/')}" for one in run_config(run).sources} if is_run(run) else set()


def scored_drive(run: Path, truth: Trajectory | None, estimate: str = "") -> Drive:
    """The last drive of a run that overlaps with the truth in time; without truth, the last drive.

    Raises GraphSlamError: the path of the run cannot be read.
    """
    drives = _drives(run)
    of_sightings = estimate == _SIGHTINGS[0] or (not estimate and not is_empty(run / _SIGHTINGS[0]))
    default, odometry = _SIGHTINGS if of_sightings else _KEYFRAMES
    name = estimate or default
    if is_empty(run / odometry):
        odometry = _SIGHTINGS[1]
    whole = read_rows(run / name)
    odometry_path = None if is_empty(run / odometry) else read_rows(run / odometry)
    drives = drives if name in (*_SIGHTINGS, *_KEYFRAMES) else _ONE_DRIVE
    chosen = None
    for k in reversed(range(len(drives))):
        follows = drives[k + 1] if k + 1 < len(drives) else {}
        rows = {key: slice(drives[k][key], follows.get(key)) for key in ("keyframe", "sighting")}
        estimated = whole.at(rows["sighting" if name in _SIGHTINGS else "keyframe"])
        reckoned = odometry_path and odometry_path.at(rows["sighting" if odometry in _SIGHTINGS else "keyframe"])
        if not len(estimated.stamps_s):
            continue
        names, reckoned = (name, odometry), reckoned and reckoned.in_order()
        part = Drive(estimated.in_order(), reckoned, names, rows["keyframe"], k + 1, len(drives))
        chosen = chosen or part
        if truth is None or np.isfinite(_rmse_m(part.estimate, truth, 2)):
            return part
    return chosen or Drive(whole.in_order(), odometry_path and odometry_path.in_order(), (name, odometry), slice(None))


def truth_in_map(run: Path, known: Truth, *, align: bool = True) -> Trajectory:
    """The true path in the frame map: the drive that it is of is laid on it."""
    drive = scored_drive(run, known.trajectory)
    found = matched(drive.estimate, known.trajectory, dimensions_of(run), align=align)
    return known.trajectory.moved(se3.inverse(found.T_truth_path))


def _drives(run: Path) -> list[dict[str, int]]:
    """The first keyframe and sighting of each drive; a single drive if the summary has none."""
    try:
        drives = summary_of(run)["drives"]
        drives = [{key: int(one[key]) for key in ("keyframe", "sighting")} for one in drives]
    except (ValueError, KeyError, TypeError):
        return _ONE_DRIVE
    return drives or _ONE_DRIVE


def _doubts(path: Trajectory, truth: Trajectory, error: PathError, dimensions: int, *, align: bool) -> Iterator[str]:
    """Errors that no good map has and, of what was aligned, what would make the truth fit far better."""
    change = _likely_mistake(path, truth, dimensions) if align else ""
    error_m, true_m = error.position_m["rmse"], _size_m(associate(path, truth)[1], dimensions)
    if change:
        yield f"the truth fits far better if {change}"
    elif error_m > max(_FAR * true_m, _FAR_M):
        far = f"the error is {error_m:.3g} m on a true path of radius {true_m:.3g} m (RMS)"
        yield f"{far}: check that the truth is of this robot and this drive"
    elif align and (angle := error.angle_rad):
        w_first = replace(truth, poses=truth.poses[:, [0, 1, 2, 4, 5, 6, 3]])
        turned = path_error(path, w_first, dimensions).angle_rad
        if turned and angle["rmse"] > max(_FAR_M, 2.0 * turned["rmse"]):
            yield "the quaternions of the truth are read as x y z w, and fit far better if w comes first"
        elif angle["median"] > _FAR_M and angle["max"] < 1.5 * angle["median"]:
            turn = f"{np.degrees(angle['median']):.0f} degrees"
            yield f"the truth's headings fit far better if turned by {turn}: is its x axis ahead?"


def _likely_mistake(path: Trajectory, truth: Trajectory, dimensions: int) -> str:
    """The mistake in the truth without which it fits far better, as a question; empty if there is none."""
    mine, true = associate(path, truth)
    size_m, count = _size_m(mine, dimensions), len(mine.stamps_s)
    k = size_m / max(_size_m(true, dimensions), 1e-9)
    some = np.random.default_rng(0).permutation(len(path.stamps_s))  # even steps may miss a slow truth
    path = path.at(some[: _MOST_POSES * len(some) // max(count, _MOST_POSES)])
    left_m = {"": _rmse_m(path, truth, dimensions)}
    if left_m[""] <= _LATE_M:
        return ""
    if not 0.8 < k < 1.25:  # in between, it may be a map with an error of scale
        what = f"scaled by {k:.2g}: is it in {'millimetres' if 8e-4 < k < 1.25e-3 else 'metres'}?"
        left_m[what] = _rmse_m(path, replace(truth, poses=truth.poses * [k, k, k, 1, 1, 1, 1]), dimensions)
    other = replace(truth, poses=truth.poses * [1, -1, 1, 1, 1, 1, 1])
    left_m["mirrored: does its y axis point to the left?"] = _rmse_m(path, other, dimensions)
    least = int(_OVERLAP * min(count, _MOST_POSES))
    for late_s in np.arange(-_MOST_LATE_S, _MOST_LATE_S, _LATE_S):
        what = f"stamped {abs(late_s):.1f} s {'earlier' if late_s > 0.0 else 'later'}: is it of another clock?"
        left_m[what] = _rmse_m(replace(path, stamps_s=path.stamps_s + late_s), truth, dimensions, least)
    what = min(left_m, key=lambda one: left_m[one])
    return what if left_m[what] < _CLEARLY * min(left_m[""], size_m) else ""


def _size_m(path: Trajectory, dimensions: int) -> float:
    """RMS distance of positions from their mean."""
    return float(np.linalg.norm(path.poses[:, :dimensions].std(axis=0)))


def _rmse_m(path: Trajectory, truth: Trajectory, dimensions: int, least: int = 2) -> float:
    """The RMSE of a path after alignment; infinite with fewer common stamps."""
    try:
        mine, true = associate(path, truth)
        error_m = _laid_rmse_m(mine.poses[:, :3], true.poses[:, :3], dimensions)
    except GraphSlamError:
        return np.inf
    return error_m if len(mine.stamps_s) >= least else np.inf


def _laid_rmse_m(points: Array, reference: Array, dimensions: int) -> float:
    """The RMSE of points (n, 3) that are laid on their reference, in the plane or in space."""
    flat = np.array([1.0, 1.0, 0.0 if dimensions == 2 else 1.0])
    T = alignment(points[:, :dimensions], reference[:, :dimensions])
    moved = np.stack(se3.act(T, tuple((flat * points).T)), axis=1)
    return float(np.sqrt(np.mean(np.sum((moved - flat * reference) ** 2, axis=1))))


def _described(drive: Drive) -> str:
    if drive.count == 1:
        return drive.names[0]
    return f"{drive.names[0]}, drive {drive.number} of {drive.count} alone: the others are of other recordings"


def _map_rmse(landmarks: dict[str, Any], true: dict[str, Point], dimensions: int) -> float | None:
    """RMSE [m] of the landmarks with the same id; None with too few."""
    shared = sorted(set(landmarks) & set(true))
    if len(shared) < dimensions:
        return None
    points, reference = (np.array([where[name] for name in shared]) for where in (landmarks, true))
    return _laid_rmse_m(points, reference, dimensions)
