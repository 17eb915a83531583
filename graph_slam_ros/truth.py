"""Paths and maps out of files: TUM, a run's table of landmarks, and the truth in a recording."""

import csv
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.lie import se3
from graph_slam_ros.ros.bag import Bag, open_bag
from graph_slam_ros.ros.definitions import recorded_decoder

Array = NDArray[np.float64]
Point = tuple[float, float, float]

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


@dataclass(frozen=True, slots=True)
class Trajectory:
    """Poses at stamps.

    Attributes
    ----------
    stamps_s : (n,) seconds, increasing
    poses : (n, 7) x, y, z [m], qx, qy, qz, qw
    """

    stamps_s: Array
    poses: Array

    def moved(self, T_new_old: se3.Pose) -> "Trajectory":
        """The same trajectory in another frame."""
        return Trajectory(self.stamps_s, np.stack(se3.compose(T_new_old, tuple(self.poses.T)), axis=1))

    def in_plane(self) -> "Trajectory":
        """Without height, roll and pitch."""
        return Trajectory(self.stamps_s, se3.in_space(se3.in_plane(self.poses)))


@dataclass(frozen=True, slots=True)
class Landmark:
    """A landmark of a run.

    Attributes
    ----------
    position : in map [m]
    covariance : (3, 3) of the position in the axes of map, zero for what a plane does not have; NaN where unknown
    """

    position: Point
    covariance: Array


@dataclass(frozen=True, slots=True)
class Truth:
    """What is known to be true.

    Attributes
    ----------
    landmarks : positions in metres by id, where they are known
    losses : what of the recording could not be read
    """

    trajectory: Trajectory
    landmarks: dict[str, Point]
    losses: tuple[str, ...] = ()


def read_tum(path: Path) -> Trajectory:
    """Poses of a TUM file (stamp x y z qx qy qz qw).

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
    return _trajectory(rows[:, 0], rows[:, 1:], str(path))


def _trajectory(stamps_s: Array, poses: Array, source: str) -> Trajectory:
    """Poses in order of stamp, with unit quaternions: files round them."""
    norm = np.linalg.norm(poses[:, 3:], axis=1, keepdims=True)
    if not (norm > 0.0).all():
        raise GraphSlamError(f"{source}: a quaternion of zeros is no rotation")
    order = np.argsort(stamps_s, kind="stable")
    return Trajectory(stamps_s[order], np.hstack([poses[:, :3], poses[:, 3:] / norm])[order])


def read_landmarks(path: Path) -> dict[str, Landmark]:
    """Landmarks by id of a run's ``landmarks.csv``; empty where there is no such file."""
    if not path.exists():
        return {}
    try:
        with path.open(newline="", encoding="utf-8") as stream:
            return {row["id"]: _landmark(row) for row in csv.DictReader(stream)}
    except (KeyError, TypeError, ValueError) as error:
        raise GraphSlamError(f"{path}: not a table of landmarks ({error})") from None


def _landmark(row: dict[str, str]) -> Landmark:
    names = "xyz" if "z" in row else "xy"
    covariance = np.zeros((3, 3))
    for i, a in enumerate(names):
        for j, b in enumerate(names[i:], start=i):
            covariance[i, j] = covariance[j, i] = float(row[f"cov_{a}{b}"])
    return Landmark((float(row["x"]), float(row["y"]), float(row.get("z", 0.0))), covariance)


def read_covariances(path: Path) -> Array:
    """Covariances of a run's ``covariances.csv``, (n, 3, 3) or (n, 6, 6), each in its pose's tangent space.

    Raises
    ------
    GraphSlamError
        It is no such table.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()[1:]
        rows = np.array([[float(word) for word in line.split(",")[1:]] for line in lines])
        dof = {6: 3, 21: 6}[rows.shape[-1]]
    except (KeyError, ValueError, OSError) as error:
        raise GraphSlamError(f"{path}: not a table of covariances ({error})") from None
    upper = np.triu_indices(dof)
    out = np.empty((len(rows), dof, dof))
    out[:, upper[0], upper[1]] = out[:, upper[1], upper[0]] = rows
    return out


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
        rows.append((p.x, p.y, p.z, q.x, q.y, q.z, q.w))
    if not rows:
        raise GraphSlamError(f"{path}: no message on {topic}")
    return _trajectory(np.array(stamps), np.array(rows, dtype=float), f"{path}, {topic}")


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


def _recorded_landmarks(bag: Bag) -> dict[str, Point]:
    kind = "vision_msgs/msg/Detection3DArray"
    if TRUE_LANDMARKS_TOPIC not in bag.topics or bag.topics[TRUE_LANDMARKS_TOPIC].type != kind:
        return {}
    out = {}
    for message in _decoded(bag, TRUE_LANDMARKS_TOPIC):
        for detection in message.detections:
            at = detection.bbox.center.position
            out[detection.id] = (float(at.x), float(at.y), float(at.z))
    return out
