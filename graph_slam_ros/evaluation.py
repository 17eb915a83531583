"""How far a run is from the truth: position, orientation and map, measured by evo; and whether it knows how far.

For the errors the estimate is moved onto the truth by the rigid motion that fits best, of the plane or of space as the
run was made, without scale; poses are compared where both have a stamp within 0.05 s. Consistency is told in the frame
that both share at the run's first pose.
"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from graph_slam_ros.consistency import ClassNoise, Consistency, class_noise, landmark_nees, pose_nees
from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.lie import se3
from graph_slam_ros.run import COVARIANCES, SUMMARY, is_run, run_config
from graph_slam_ros.truth import Point, Trajectory, Truth, read_covariances, read_landmarks, read_truth, read_tum

Array = NDArray[np.float64]

MAX_STAMP_DIFFERENCE_S = 0.05
_STATISTICS = ("rmse", "median", "max")
_EXACT_S = 1e-6  # stamps in seconds are rounded to less


@dataclass(frozen=True, slots=True)
class PathError:
    """Errors of a path at n stamps, each as {rmse, median, max}."""

    position_m: dict[str, float]
    angle_rad: dict[str, float]
    n: int


@dataclass(frozen=True, slots=True)
class Scores:
    """Errors of a run.

    Attributes
    ----------
    odometry : the same for dead reckoning, or None where the run has none
    map_rmse_m : of landmarks with the same id, aligned by themselves; None with too few to align or without truth
    consistency : of the run, or None where it left no covariances
    dimensions : 2 or 3
    losses : what of the truth could not be read
    """

    estimate: PathError
    odometry: PathError | None
    map_rmse_m: float | None
    consistency: Consistency | None = None
    dimensions: int = 2
    losses: tuple[str, ...] = ()

    @property
    def _angle(self) -> str:
        return "heading" if self.dimensions == 2 else "angle"

    def as_dict(self) -> dict[str, Any]:
        """Plain values; what there is not is None. Angles are ``heading_rad`` in the plane, ``angle_rad`` in space."""

        def plain(error: PathError) -> dict[str, Any]:
            return {"position_m": error.position_m, f"{self._angle}_rad": error.angle_rad, "n": error.n}

        return plain(self.estimate) | {
            "map_m": None if self.map_rmse_m is None else {"rmse": self.map_rmse_m},
            "odometry": self.odometry and plain(self.odometry),
            "consistency": self.consistency and self.consistency.as_dict(),
        }

    def __str__(self) -> str:
        lines = [f"{f'error at {self.estimate.n} stamps':30s}{'rmse':>10s}{'median':>10s}{'max':>10s}"]
        for name, error in (("estimate", self.estimate), ("dead reckoning", self.odometry)):
            if error is not None:
                lines.append(_line(f"{name}, position [m]", error.position_m, 1.0, 3))
                lines.append(_line(f"{name}, {self._angle} [deg]", error.angle_rad, 180.0 / np.pi, 2))
        if self.map_rmse_m is not None:
            lines.append(f"{'landmarks, position [m]':30s}{self.map_rmse_m:10.3f}")
        if self.consistency is not None:
            lines.append(str(self.consistency))
        return "\n".join(lines)


def _line(name: str, values: dict[str, float], factor: float, digits: int) -> str:
    return f"{name:30s}" + "".join(f"{factor * values[key]:10.{digits}f}" for key in _STATISTICS)


def evaluate(run: Path, truth: str | Path, estimate: str = "sightings.tum") -> Scores:
    """Compare a run's folder with the truth.

    Parameters
    ----------
    truth : ``BAG``, ``BAG:TOPIC`` or ``FILE.tum``
    estimate : which path of the run is scored

    Raises
    ------
    GraphSlamError
        A file or topic that is missing or unreadable, too few common stamps, or no evo.
    """
    known, dimensions = read_truth(truth), dimensions_of(run)
    odometry = run / "odometry.tum"
    landmarks = {name: landmark.position for name, landmark in read_landmarks(run / "landmarks.csv").items()}
    return Scores(
        path_error(read_tum(run / estimate), known.trajectory, dimensions),
        path_error(read_tum(odometry), known.trajectory, dimensions) if odometry.exists() else None,
        _map_rmse(landmarks, known.landmarks, dimensions),
        _consistency(run, known),
        dimensions,
        known.losses,
    )


def dimensions_of(run: Path) -> int:
    """In how many dimensions a run was made: 2 where it does not say."""
    return run_config(run).world.dimensions if is_run(run) else 2


def path_error(estimate: Trajectory, truth: Trajectory, dimensions: int = 2) -> PathError:
    """Errors of one path, aligned by itself."""
    metrics = _evo("metrics")
    if dimensions == 2:
        estimate, truth = estimate.in_plane(), truth.in_plane()
    matched, reference = associate(estimate, truth)
    aligned = matched.moved(alignment(matched.poses[:, :dimensions], reference.poses[:, :dimensions]))
    found = []
    for relation in (metrics.PoseRelation.translation_part, metrics.PoseRelation.rotation_angle_rad):
        error = metrics.APE(relation)
        error.process_data((_evo_path(reference), _evo_path(aligned)))
        found.append({name: float(error.get_statistic(metrics.StatisticsType[name])) for name in _STATISTICS})
    return PathError(found[0], found[1], len(aligned.stamps_s))


def associate(estimate: Trajectory, truth: Trajectory) -> tuple[Trajectory, Trajectory]:
    """The poses of both that belong together: nearest stamps, within 0.05 s, none before or after the truth.

    Raises
    ------
    GraphSlamError
        Fewer than two.
    """
    inside = (estimate.stamps_s >= truth.stamps_s[0]) & (estimate.stamps_s <= truth.stamps_s[-1])
    ids, theirs = _evo("sync").matching_time_indices(estimate.stamps_s[inside], truth.stamps_s, MAX_STAMP_DIFFERENCE_S)
    mine = np.flatnonzero(inside)[ids].tolist() if ids else []
    if len(mine) < 2:
        raise GraphSlamError(
            f"{len(mine)} of {len(estimate.stamps_s)} stamps are within {MAX_STAMP_DIFFERENCE_S} s of the truth's:"
            f" the estimate spans {_span(estimate)}, the truth {_span(truth)}"
        )
    return tuple(Trajectory(t.stamps_s[at], t.poses[at]) for t, at in ((estimate, mine), (truth, theirs)))  # type: ignore[return-value]


def alignment(points: Array, reference: Array) -> se3.Pose:
    """The rigid motion that takes points (n, 2) or (n, 3) nearest to their reference.

    Of the plane where they have two coordinates: a rotation there cannot turn into the mirror image that turning over
    in space would allow.

    Raises
    ------
    GraphSlamError
        All points are in one place, or in space on a line.
    """
    geometry = _evo("geometry")
    dimensions = points.shape[1]
    try:
        rotation, translation, _ = geometry.umeyama_alignment(points.T, reference.T, False)
    except geometry.GeometryException:
        where = "in one place" if dimensions == 2 else "on a line"
        raise GraphSlamError(f"cannot align: all positions are {where}") from None
    full = np.eye(3)
    full[:dimensions, :dimensions] = rotation
    turn = Rotation.from_matrix(full).as_quat()
    x, y, z = (*translation.tolist(), 0.0)[:3]
    return (x, y, z, *turn.tolist())


def _map_rmse(landmarks: dict[str, Point], true: dict[str, Point], dimensions: int) -> float | None:
    """RMSE in metres of the landmarks whose ids both have."""
    shared = sorted(set(landmarks) & set(true))
    if len(shared) < dimensions:
        return None
    flat = np.array([1.0, 1.0, 0.0 if dimensions == 2 else 1.0])
    points, reference = (np.array([where[name] for name in shared]) * flat for where in (landmarks, true))
    moved = np.stack(se3.act(alignment(points[:, :dimensions], reference[:, :dimensions]), tuple(points.T)), axis=1)
    level = np.tile(se3.IDENTITY[3:], (len(shared), 1))
    metrics = _evo("metrics")
    error = metrics.APE(metrics.PoseRelation.translation_part)
    at = np.zeros(len(shared))
    error.process_data(tuple(_evo_path(Trajectory(at, np.hstack([p, level]))) for p in (reference, moved)))
    return float(error.get_statistic(metrics.StatisticsType.rmse))


def _consistency(run: Path, known: Truth) -> Consistency | None:
    """From what the run left; None where it left no covariances."""
    if not (run / COVARIANCES).exists():
        return None
    path, covariances = read_tum(run / "path.tum"), read_covariances(run / COVARIANCES)
    if len(covariances) != len(path.stamps_s):
        raise GraphSlamError(f"{run / COVARIANCES}: {len(covariances)} covariances of {len(path.stamps_s)} poses")
    truth = known.trajectory if covariances.shape[1] == 6 else known.trajectory.in_plane()
    true = interpolated(truth, path.stamps_s)
    is_held, noise = _classes(run)
    if is_held:  # by the fixes, not by the first pose, and nobody says in which frame
        true[:] = np.nan
    landmarks = read_landmarks(run / "landmarks.csv")
    unknown = (np.nan, np.nan, np.nan)
    of_landmarks = landmark_nees(
        np.array([landmark.position for landmark in landmarks.values()]).reshape(-1, 3),
        np.array([known.landmarks.get(name, unknown) for name in landmarks]).reshape(-1, 3),
        np.array([landmark.covariance for landmark in landmarks.values()]).reshape(-1, 3, 3),
        path.poses[0],
        true[0],
        covariances[0],
    )
    return Consistency(*pose_nees(path.poses, true, covariances), of_landmarks, noise)


def _classes(run: Path) -> tuple[bool, dict[str, ClassNoise]]:
    """Whether fixes hold the map, and what each class of edges says of its sigmas, by the summary of a run."""
    try:
        summary = json.loads((run / SUMMARY).read_text(encoding="utf-8"))
        return "fixes" in summary["classes"], class_noise(summary["classes"], summary["leverage"])
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise GraphSlamError(f"{run / SUMMARY}: not a summary of a run ({type(error).__name__}: {error})") from None


def interpolated(truth: Trajectory, stamps_s: Array) -> Array:
    """True poses (n, 7) at stamps (n,), between neighbours at most twice 0.05 s apart; elsewhere NaN."""
    after = np.clip(np.searchsorted(truth.stamps_s, stamps_s), 1, max(1, len(truth.stamps_s) - 1))
    before = after - 1
    after = np.minimum(after, len(truth.stamps_s) - 1)
    first, gap = truth.stamps_s[before], truth.stamps_s[after] - truth.stamps_s[before]
    fraction = (stamps_s - first) / np.where(gap > 0.0, gap, 1.0)
    out = np.stack(se3.interpolate(tuple(truth.poses[before].T), tuple(truth.poses[after].T), fraction), axis=1)
    off_s = np.minimum(np.abs(stamps_s - first), np.abs(truth.stamps_s[after] - stamps_s))
    between = (fraction >= 0.0) & (fraction <= 1.0) & (gap <= 2.0 * MAX_STAMP_DIFFERENCE_S)
    out[~(between | (off_s <= _EXACT_S))] = np.nan
    return out


def _evo(module: str) -> Any:
    """A module of evo's core; it takes half a second and not everybody has it."""
    try:
        from evo.core import geometry, metrics, sync, trajectory
    except ImportError:
        raise GraphSlamError("scores need evo: pip install 'graph_slam_ros[evaluate]'") from None
    return {"geometry": geometry, "metrics": metrics, "sync": sync, "trajectory": trajectory}[module]


def _evo_path(t: Trajectory) -> Any:
    return _evo("trajectory").PosePath3D(t.poses[:, :3], np.roll(t.poses[:, 3:], 1, axis=1))


def _span(t: Trajectory) -> str:
    return f"{t.stamps_s[0]:.3f} to {t.stamps_s[-1]:.3f} s"
