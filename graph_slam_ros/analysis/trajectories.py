"""The truth that a run is compared with: a TUM file, or a topic of a recording.

A recording may have the robot's pose (PoseStamped, PoseWithCovarianceStamped, TransformStamped, Odometry, a transform
on TF) or its position alone (PointStamped; NavSatFix, then east, north and up of its first fix).
"""

import math
from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from graph_slam_ros.errors import GraphSlamError, did_you_mean
from graph_slam_ros.lie import se3
from graph_slam_ros.messages.inputs.fixes import east_north_up
from graph_slam_ros.recordings.bag import Bag, open_bag
from graph_slam_ros.recordings.definitions import recorded_decoder
from graph_slam_ros.runs.folder import is_run
from graph_slam_ros.runs.trajectory import MOST, Point, Trajectory, read_tum, trajectory
from graph_slam_ros.typing import Array

TRUTH_TOPIC = "/ground_truth"
TRUE_LANDMARKS_TOPIC = "/landmarks_ground_truth"
_ODOMETRY_TOPIC = "/odom"
_ODOMETRY = "nav_msgs/msg/Odometry"
_FIX = "sensor_msgs/msg/NavSatFix"
_POINT = "geometry_msgs/msg/PointStamped"
_TF = "tf2_msgs/msg/TFMessage"
_POSE_TYPES = (
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "geometry_msgs/msg/TransformStamped",
    _POINT,
    _FIX,
    _ODOMETRY,
)
_LOCALISERS = ("amcl_pose", "pcl_pose", "ndt_pose", "slam_pose", "localization_pose", "estimated_pose")
_CAPTURED_M, _UNKNOWN_M = 0.005, 1e3  # below the first it may be motion capture; the second stands for unknown
_FIRST = 100
_BENT = 0.05  # size of a path across its longest direction, as a part of that: a line has less
Row = tuple[int, tuple[float, ...]]  # stamp [ns] and pose (7,)


@dataclass(frozen=True, slots=True)
class Truth:
    """The true poses and landmarks of a drive.

    Attributes
    ----------
    landmarks : positions in metres by id, where they are known
    losses : what of the recording could not be read
    source : the file, or the topic with its type
    doubt : why it may be an estimate and not the truth; empty where nothing says so
    """

    trajectory: Trajectory
    landmarks: dict[str, Point]
    losses: tuple[str, ...] = ()
    source: str = ""
    topic: str = ""
    doubt: str = ""


def read_truth(truth: str | Path, topic: str = "", not_these: Collection[str] = ()) -> Truth:
    """True poses and landmarks. Raises GraphSlamError: no such file, or no such topic; those that exist are named.

    Parameters
    ----------
    truth : ``BAG``, ``BAG:TOPIC`` or ``FILE.tum``
    topic : of the recording; of a topic of transforms also ``TOPIC:PARENT:CHILD``, the names of two frames.
        Default: ``/ground_truth``, else the only topic that can be the truth
    not_these : topics that are not chosen by default
    """
    path, named = _file_and_topic(str(truth))
    topic = topic or named
    if path.suffix in (".tum", ".txt", ".csv"):
        if topic:
            raise GraphSlamError(f"{path}: a TUM file has no topics: leave out {topic}")
        known = read_tum(path, follow=True)
        return Truth(replace(known, has_orientation=not _is_empty_heading(known.poses)), {}, source=str(path))
    if is_run(path):
        raise GraphSlamError(f"{path}: a run, not the truth: graph_slam evaluate RUN --truth BAG or FILE.tum")
    bag = open_bag(path)
    name, _, frames = (topic or _only_topic(bag, path, not_these)).partition(":")
    if name not in bag.topics or bag.topics[name].type not in (*_POSE_TYPES, _TF):
        raise GraphSlamError(f"{path}: no topic {name} of poses; {_listed(bag)}{did_you_mean(name, bag.topics)}")
    kind = bag.topics[name].type
    rows = _transforms(bag, path, name, frames) if kind == _TF else list(_rows(bag, name, kind))
    finite = [row for row in rows if np.abs(row[1]).max() < MOST]
    if len(finite) < len(rows):
        bag.losses.append(f"{len(rows) - len(finite)} of {len(rows)} poses on {name} are not finite")
    if not finite:
        raise GraphSlamError(f"{path}: nothing on {name} is a pose of the robot")
    stamps_s = np.array([stamp_ns / 10**9 for stamp_ns, _ in finite])  # one rounding, as in a TUM file
    found = trajectory(stamps_s, np.array([pose for _, pose in finite], dtype=float), f"{path}, {name}")
    found = replace(found, has_orientation=kind not in (_FIX, _POINT) and not _is_empty_heading(found.poses))
    landmarks = _recorded_landmarks(bag)
    source = f"{topic or name} ({kind})"
    return Truth(found, landmarks, tuple(bag.losses), source, name, _doubt(bag, source, name, frames))


def _doubt(bag: Bag, source: str, topic: str, frames: str) -> str:
    """Return why poses are those of a localiser: by the covariance that they have, the name, or the frames."""
    sigma_m = _stated_sigma(bag, topic)
    if _CAPTURED_M < sigma_m < _UNKNOWN_M:
        why = f"its poses have a covariance (a standard deviation of {sigma_m:.3g} m)"
    elif topic.rpartition("/")[2] in _LOCALISERS or "filtered" in topic:
        why = "by its name it is the output of a localiser or filter"
    elif frames and {one.lstrip("/") for one in frames.split(":")} & {"map", "odom"}:
        why = "map and odom are frames of a localiser"
    else:
        return ""
    return f"{source} is called the truth, but {why}: then the errors are differences between two estimates"


def _is_empty_heading(poses: Array) -> bool:
    """Return whether all orientations are the same, although the path does not go along a line."""
    if len(poses) < 3 or (poses[:, 3:] != poses[0, 3:]).any():
        return False
    sizes = np.linalg.svd(poses[:, :3] - poses[:, :3].mean(axis=0), compute_uv=False)
    return bool(sizes[1] > _BENT * sizes[0])


def _file_and_topic(truth: str) -> tuple[Path, str]:
    """Split at the first colon that a file ends at; a name may hold colons itself."""
    path = Path(truth)
    at = truth.find(":")
    while not path.exists() and at >= 0:
        if at and (Path(truth[:at]).exists() or truth.find(":", at + 1) < 0 or truth[at + 1] == "/"):
            return Path(truth[:at]), truth[at + 1 :]
        at = truth.find(":", at + 1)
    return path, ""


def _only_topic(bag: Bag, path: Path, not_these: Collection[str]) -> str:
    """``/ground_truth``, or the only topic that can be the truth: one of odometry only where there is no other."""
    if TRUTH_TOPIC in bag.topics:
        return TRUTH_TOPIC
    left_out = {_ODOMETRY_TOPIC, *not_these}
    found = [t for t in bag.topics.values() if t.type in _POSE_TYPES and t.name not in left_out]
    best = [t.name for t in found if t.type != _ODOMETRY] or [t.name for t in found]
    if len(best) == 1:
        return best[0]
    if best:
        raise GraphSlamError(f"{path}: several topics may be the truth: {', '.join(sorted(best))}; choose with --topic")
    raise GraphSlamError(f"{path}: no topic {TRUTH_TOPIC}; name the truth with --topic TOPIC, {_listed(bag)}")


def _listed(bag: Bag) -> str:
    names = sorted(t.name for t in bag.topics.values() if t.type in _POSE_TYPES)
    names += [f"{t.name}:PARENT:CHILD" for t in bag.topics.values() if t.type == _TF and t.name != "/tf_static"]
    return f"with poses there are {', '.join(names)}" if names else "but no topic has poses"


def _stated_sigma(bag: Bag, topic: str) -> float:
    """The largest standard deviation in x or y that the first poses of a topic have; 0 if they have none."""
    poses = [getattr(message, "pose", None) for message in islice(_decoded(bag, topic), _FIRST)]
    covariances = [getattr(pose, "covariance", (0.0,) * 36) for pose in poses]
    variances = [float(covariance[k]) for covariance in covariances for k in (0, 7)]
    return math.sqrt(max((v for v in variances if v > 0.0), default=0.0))


def _rows(bag: Bag, topic: str, kind: str) -> Iterator[Row]:
    datum: tuple[float, float, float] | None = None
    for message in _decoded(bag, topic):
        stamp_ns = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
        if kind == _FIX:
            here = (message.latitude, message.longitude, message.altitude)
            if message.status.status < 0 or not all(map(math.isfinite, here[:2])) or here[0] == here[1] == 0.0:
                continue
            here = (*here[:2], here[2] if math.isfinite(here[2]) else datum[2] if datum else 0.0)
            datum = datum or here
            yield stamp_ns, (*east_north_up(here, datum), *se3.IDENTITY[3:])
        elif kind == _POINT:
            yield stamp_ns, (message.point.x, message.point.y, message.point.z, *se3.IDENTITY[3:])
        else:
            yield stamp_ns, _pose(message)


def _transforms(bag: Bag, path: Path, topic: str, frames: str) -> list[Row]:
    """The transforms of one pair of frames: the named one, or the one that does not touch a frame of the robot."""
    found: dict[tuple[str, str], list[Row]] = {}
    for message in _decoded(bag, topic):
        for one in message.transforms:
            pair = (one.header.frame_id.lstrip("/"), one.child_frame_id.lstrip("/"))
            t = one.header.stamp
            row = (t.sec * 10**9 + t.nanosec, _pose(one))
            found.setdefault(pair, []).append(row)
    names = ", ".join(f"{topic}:{parent}:{child}" for parent, child in sorted(found))
    if frames:
        parent, _, child = frames.partition(":")
        pair = (parent.lstrip("/"), child.lstrip("/"))
        if pair not in found:
            raise GraphSlamError(f"{path}: no transform {topic}:{frames}; there are {names or 'none'}")
        return found[pair]
    if len(found) == 1:
        return next(iter(found.values()))
    raise GraphSlamError(f"{path}: {topic} has several transforms: choose with --topic one of {names or 'none'}")


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


def _pose(message: Any) -> tuple[float, ...]:
    """The numbers (7,) of a pose or transform, in a message of its own or in one of a header and of that."""
    if hasattr(message, "transform"):
        p, q = message.transform.translation, message.transform.rotation
    else:
        pose = message.pose if hasattr(message.pose, "position") else message.pose.pose
        p, q = pose.position, pose.orientation
    return p.x, p.y, p.z, q.x, q.y, q.z, q.w


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
