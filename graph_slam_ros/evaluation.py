"""How far a run is from the truth: position, heading and map, measured by evo.

The estimate is moved onto the truth by the rigid motion of the plane that fits best, without scale; poses are compared
where both have a stamp within 0.05 s.
"""

import csv
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.lie import se2
from graph_slam_ros.ros.bag import Bag, open_bag
from graph_slam_ros.ros.definitions import recorded_decoder

Array = NDArray[np.float64]

MAX_STAMP_DIFFERENCE_S = 0.05
TRUTH_TOPIC = "/ground_truth"
TRUE_LANDMARKS_TOPIC = "/landmarks_ground_truth"
_ODOMETRY_TOPIC = "/odom"
_ODOMETRY = "nav_msgs/msg/Odometry"
_POSE_TYPES = (
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "geometry_msgs/msg/TransformStamped",
    _ODOMETRY,
)
_STATISTICS = ("rmse", "median", "max")


@dataclass(frozen=True, slots=True)
class Trajectory:
    """Poses of the plane at stamps.

    Attributes
    ----------
    stamps_s : (n,) seconds, increasing
    poses : (n, 3) x, y [m], theta [rad]
    """

    stamps_s: Array
    poses: Array

    def moved(self, T_new_old: se2.Pose) -> "Trajectory":
        """The same trajectory in another frame."""
        x, y, theta = se2.compose(T_new_old, tuple(self.poses.T))
        return Trajectory(self.stamps_s, np.column_stack([x, y, se2.wrap(theta)]))


@dataclass(frozen=True, slots=True)
class Truth:
    """What is known to be true.

    Attributes
    ----------
    landmarks : positions (x, y) in metres by id, where they are known
    losses : what of the recording could not be read
    """

    trajectory: Trajectory
    landmarks: dict[str, tuple[float, float]]
    losses: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class PathError:
    """Errors of a path at n stamps, each as {rmse, median, max}."""

    position_m: dict[str, float]
    heading_rad: dict[str, float]
    n: int


@dataclass(frozen=True, slots=True)
class Scores:
    """Errors of a run.

    Attributes
    ----------
    odometry : the same for dead reckoning, or None where the run has none
    map_rmse_m : of landmarks with the same id, aligned by themselves; None with fewer than two or without truth
    losses : what of the truth could not be read
    """

    estimate: PathError
    odometry: PathError | None
    map_rmse_m: float | None
    losses: tuple[str, ...] = ()

    def as_dict(self) -> dict[str, Any]:
        """Plain values; ``map_m`` and ``odometry`` are None where there are none."""
        odometry = self.odometry
        return {
            "position_m": self.estimate.position_m,
            "heading_rad": self.estimate.heading_rad,
            "map_m": None if self.map_rmse_m is None else {"rmse": self.map_rmse_m},
            "n": self.estimate.n,
            "odometry": odometry
            and {"position_m": odometry.position_m, "heading_rad": odometry.heading_rad, "n": odometry.n},
        }

    def __str__(self) -> str:
        lines = [f"{f'error at {self.estimate.n} stamps':30s}{'rmse':>10s}{'median':>10s}{'max':>10s}"]
        for name, error in (("estimate", self.estimate), ("dead reckoning", self.odometry)):
            if error is not None:
                lines.append(_line(f"{name}, position [m]", error.position_m, 1.0, 3))
                lines.append(_line(f"{name}, heading [deg]", error.heading_rad, 180.0 / np.pi, 2))
        if self.map_rmse_m is not None:
            lines.append(f"{'landmarks, position [m]':30s}{self.map_rmse_m:10.3f}")
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
    known = read_truth(truth)
    odometry = run / "odometry.tum"
    return Scores(
        path_error(read_tum(run / estimate), known.trajectory),
        path_error(read_tum(odometry), known.trajectory) if odometry.exists() else None,
        _map_rmse(read_landmarks(run / "landmarks.csv"), known.landmarks),
        known.losses,
    )


def path_error(estimate: Trajectory, truth: Trajectory) -> PathError:
    """Errors of one path, aligned by itself."""
    metrics = _evo("metrics")
    matched, reference = associate(estimate, truth)
    aligned = matched.moved(alignment(matched.poses[:, :2], reference.poses[:, :2]))
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


def alignment(points: Array, reference: Array) -> se2.Pose:
    """The rigid motion of the plane that takes points (n, 2) nearest to their reference (n, 2).

    In two dimensions, where a rotation cannot turn into the mirror image that turning over in space would allow.

    Raises
    ------
    GraphSlamError
        All points are in one place.
    """
    geometry = _evo("geometry")
    try:
        rotation, translation, _ = geometry.umeyama_alignment(points.T, reference.T, False)
    except geometry.GeometryException:
        raise GraphSlamError("cannot align: all positions are in one place") from None
    return float(translation[0]), float(translation[1]), float(np.arctan2(rotation[1, 0], rotation[0, 0]))


def _map_rmse(landmarks: dict[str, tuple[float, float]], true: dict[str, tuple[float, float]]) -> float | None:
    """RMSE in metres of the landmarks whose ids both have."""
    shared = sorted(set(landmarks) & set(true))
    if len(shared) < 2:
        return None
    points, reference = (np.array([where[name] for name in shared]) for where in (landmarks, true))
    x, y = se2.act(alignment(points, reference), tuple(points.T))
    metrics = _evo("metrics")
    error = metrics.APE(metrics.PoseRelation.translation_part)
    at = np.zeros(len(shared))
    pair = (Trajectory(at, np.column_stack([*reference.T, at])), Trajectory(at, np.column_stack([x, y, at])))
    error.process_data(tuple(_evo_path(t) for t in pair))
    return float(error.get_statistic(metrics.StatisticsType.rmse))


def _evo(module: str) -> Any:
    """A module of evo's core; it takes half a second and not everybody has it."""
    try:
        from evo.core import geometry, metrics, sync, trajectory
    except ImportError:
        raise GraphSlamError("scores need evo: pip install 'graph_slam_ros[evaluate]'") from None
    return {"geometry": geometry, "metrics": metrics, "sync": sync, "trajectory": trajectory}[module]


def _evo_path(t: Trajectory) -> Any:
    x, y, theta = t.poses.T
    zero = np.zeros(len(x))
    quat_wxyz = np.column_stack([np.cos(0.5 * theta), zero, zero, np.sin(0.5 * theta)])
    return _evo("trajectory").PosePath3D(np.column_stack([x, y, zero]), quat_wxyz)


def _span(t: Trajectory) -> str:
    return f"{t.stamps_s[0]:.3f} to {t.stamps_s[-1]:.3f} s"


# -- files -----------------------------------------------------------------------------------------------------------


def read_tum(path: Path) -> Trajectory:
    """Poses of a TUM file (stamp x y z qx qy qz qw); z, roll and pitch are left out.

    Raises
    ------
    GraphSlamError
        No such file, nothing in it, or rows that are not eight numbers.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except FileNotFoundError:
        raise GraphSlamError(f"{path}: no such file") from None
    except (OSError, UnicodeDecodeError) as error:
        raise GraphSlamError(f"{path}: not a readable text file ({type(error).__name__})") from None
    found = []
    for number, line in enumerate(lines, start=1):
        if line.strip() and not line.lstrip().startswith("#"):
            try:
                found.append([float(word) for word in line.split()])
            except ValueError as error:
                raise GraphSlamError(f"{path}:{number}: {error}") from None
            if len(found[-1]) != 8 or not np.isfinite(found[-1]).all():
                raise GraphSlamError(f"{path}:{number}: a row of a TUM file is eight finite numbers")
    if not found:
        raise GraphSlamError(f"{path}: no pose in it")
    rows = np.array(found)
    return _trajectory(rows[:, 0], rows[:, 1:3], rows[:, 4:])


def _trajectory(stamps_s: Array, positions: Array, quat_xyzw: Array) -> Trajectory:
    """Planar poses in order of stamp."""
    qx, qy, qz, qw = quat_xyzw.T
    theta = np.arctan2(2.0 * (qw * qz + qx * qy), qw**2 + qx**2 - qy**2 - qz**2)
    order = np.argsort(stamps_s, kind="stable")
    return Trajectory(stamps_s[order], np.column_stack([positions, theta])[order])


def read_landmarks(path: Path) -> dict[str, tuple[float, float]]:
    """Positions (x, y) [m] by id of a run's ``landmarks.csv``; empty where there is no such file."""
    if not path.exists():
        return {}
    try:
        with path.open(newline="", encoding="utf-8") as stream:
            return {row["id"]: (float(row["x"]), float(row["y"])) for row in csv.DictReader(stream)}
    except (KeyError, TypeError, ValueError) as error:
        raise GraphSlamError(f"{path}: not a table of landmarks ({error})") from None


def read_truth(truth: str | Path) -> Truth:
    """True poses and landmarks from ``BAG``, ``BAG:TOPIC`` or ``FILE.tum``.

    Raises
    ------
    GraphSlamError
        No such file, or no such topic; those that exist are named.
    """
    path, topic = Path(truth), ""
    if not path.exists() and ":" in str(truth):
        before, _, topic = str(truth).rpartition(":")
        path = Path(before)
    if path.suffix in (".tum", ".txt"):
        return Truth(read_tum(path), {})
    bag = open_bag(path)
    poses, landmarks = _recorded_poses(bag, topic or _truth_topic(bag, path), path), _recorded_landmarks(bag)
    return Truth(poses, landmarks, tuple(bag.losses))


def _truth_topic(bag: Bag, path: Path) -> str:
    """``/ground_truth``, or the only topic of poses besides the odometry (of its type only where there is no other)."""
    if TRUTH_TOPIC in bag.topics:
        return TRUTH_TOPIC
    poses = [t for t in bag.topics.values() if t.type in _POSE_TYPES and t.name != _ODOMETRY_TOPIC]
    best = [t.name for t in poses if t.type != _ODOMETRY] or [t.name for t in poses]
    if len(best) == 1:
        return best[0]
    raise GraphSlamError(f"{path}: no topic {TRUTH_TOPIC}; name the truth as BAG:TOPIC, {_listed(bag)}")


def _listed(bag: Bag) -> str:
    names = sorted(t.name for t in bag.topics.values() if t.type in _POSE_TYPES)
    return f"with poses there are {', '.join(names)}" if names else "but no topic has poses"


def _recorded_poses(bag: Bag, topic: str, path: Path) -> Trajectory:
    if topic not in bag.topics or bag.topics[topic].type not in _POSE_TYPES:
        raise GraphSlamError(f"{path}: no topic {topic} of poses; {_listed(bag)}")
    stamps, rows = [], []
    for message in _decoded(bag, topic):
        p, q = _position_and_orientation(message)
        # One rounding, as of the decimal text in a TUM file: equal stamps stay equal.
        stamps.append((message.header.stamp.sec * 10**9 + message.header.stamp.nanosec) / 10**9)
        rows.append((p.x, p.y, q.x, q.y, q.z, q.w))
    if not rows:
        raise GraphSlamError(f"{path}: no message on {topic}")
    table = np.array(rows)
    return _trajectory(np.array(stamps), table[:, :2], table[:, 2:])


def _decoded(bag: Bag, topic: str) -> Iterator[Any]:
    decode = recorded_decoder(bag.topics[topic])
    for record in bag.messages([topic]):
        try:
            message = decode(record.cdr)
        except Exception:  # of damaged bytes rosbags raises almost anything
            loss = f"a message on {topic} cannot be decoded"
            bag.losses += [loss] if loss not in bag.losses else []
            continue
        yield message


def _position_and_orientation(message: Any) -> tuple[Any, Any]:
    if hasattr(message, "transform"):
        return message.transform.translation, message.transform.rotation
    pose = message.pose if hasattr(message.pose, "position") else message.pose.pose
    return pose.position, pose.orientation


def _recorded_landmarks(bag: Bag) -> dict[str, tuple[float, float]]:
    kind = "vision_msgs/msg/Detection3DArray"
    if TRUE_LANDMARKS_TOPIC not in bag.topics or bag.topics[TRUE_LANDMARKS_TOPIC].type != kind:
        return {}
    out = {}
    for message in _decoded(bag, TRUE_LANDMARKS_TOPIC):
        for detection in message.detections:
            at = detection.bbox.center.position
            out[detection.id] = (float(at.x), float(at.y))
    return out
