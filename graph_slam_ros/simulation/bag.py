"""A recording as one mcap bag: what a robot would have recorded, and the truth beside it."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from graph_slam_ros.ros.bag import BagWriter
from graph_slam_ros.ros.to_msg import covariance6, encode, header, in_parent_axes, make, pose, pose_stamped, vector
from graph_slam_ros.simulation.recording import LANDMARKS_TOPIC, Recording, Seen

Array = NDArray[np.float64]

ODOMETRY_TOPIC = "/odom"
TRUTH_TOPIC = "/ground_truth"
TRUE_LANDMARKS_TOPIC = "/landmarks_ground_truth"
_DETECTIONS = "vision_msgs/msg/Detection3DArray"
_UNUSED = 1e6  # variance of what a planar robot does not measure: z, roll, pitch, a point's yaw
_SURVEYED_M = 1e-3  # truth has no error; a covariance of zero would mean unknown


def write_bag(recording: Recording, path: Path | str) -> None:
    """Write a bag in order of stamp.

    ``/odom`` nav_msgs/Odometry (odom, base_link), ``/landmarks`` vision_msgs/Detection3DArray (base_link),
    ``/ground_truth`` geometry_msgs/PoseStamped and, once, ``/landmarks_ground_truth`` Detection3DArray (world).
    """
    seen = {s.stamp_ns: s for s in recording.seen}
    twist_covariance = covariance6(recording.twist_covariance, _UNUSED)
    with BagWriter(path) as bag:
        first_ns = int(recording.stamps_ns[0])
        for k, stamp_ns in enumerate(recording.stamps_ns.tolist()):
            bag.write(ODOMETRY_TOPIC, "nav_msgs/msg/Odometry", stamp_ns, _odometry(recording, k, twist_covariance))
            if stamp_ns in seen:
                bag.write(LANDMARKS_TOPIC, _DETECTIONS, stamp_ns, _seen(seen[stamp_ns]))
            truth = pose_stamped(stamp_ns, "world", tuple(recording.T_world_base[k].tolist()))
            bag.write(TRUTH_TOPIC, "geometry_msgs/msg/PoseStamped", stamp_ns, truth)
            if stamp_ns == first_ns:
                bag.write(TRUE_LANDMARKS_TOPIC, _DETECTIONS, stamp_ns, _true_landmarks(recording))


def _odometry(recording: Recording, k: int, twist_covariance: Array) -> bytes:
    at = tuple(recording.T_odom_base[k].tolist())
    vx, vy, turn = recording.twist[k].tolist()
    covariance = covariance6(in_parent_axes(at, recording.odom_covariance[k]), _UNUSED)
    twist = make("geometry_msgs/msg/Twist", linear=vector(vx, vy), angular=vector(0.0, 0.0, turn))
    message = make(
        "nav_msgs/msg/Odometry",
        header=header(int(recording.stamps_ns[k]), "odom"),
        child_frame_id="base_link",
        pose=make("geometry_msgs/msg/PoseWithCovariance", pose=pose(at), covariance=covariance),
        twist=make("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=twist_covariance),
    )
    return encode(message)


def _seen(seen: Seen) -> bytes:
    return _detections(seen.stamp_ns, "base_link", zip(seen.ids, seen.measured, seen.covariance, strict=True))


def _true_landmarks(recording: Recording) -> bytes:
    """The true map; landmarks that were seen as poses have their orientation known."""
    size = recording.seen[0].measured.shape[1] if recording.seen else 2
    covariance = _SURVEYED_M**2 * np.eye(size)
    found = ((name, np.array(p[:size]), covariance) for name, p in recording.landmarks.items())
    return _detections(int(recording.stamps_ns[0]), "world", found)


def _detections(stamp_ns: int, frame: str, found: Iterable[tuple[str, Array, Array]]) -> bytes:
    """One Detection3DArray of (id, position or pose, covariance in the axes of the frame)."""
    head = header(stamp_ns, frame)
    detections = [_detection(head, name, z.tolist(), covariance) for name, z, covariance in found]
    return encode(make(_DETECTIONS, header=head, detections=detections))


def _detection(head: Any, name: str, measured: list[float], covariance: Array) -> Any:
    planar = np.diag([0.0, 0.0, _UNUSED])
    planar[: len(measured), : len(measured)] = covariance
    at = pose((measured[0], measured[1], measured[2] if len(measured) == 3 else 0.0))
    posed = make("geometry_msgs/msg/PoseWithCovariance", pose=at, covariance=covariance6(planar, _UNUSED))
    hypothesis = make("vision_msgs/msg/ObjectHypothesis", class_id=name, score=1.0)
    return make(
        "vision_msgs/msg/Detection3D",
        header=head,
        results=[make("vision_msgs/msg/ObjectHypothesisWithPose", hypothesis=hypothesis, pose=posed)],
        bbox=make("vision_msgs/msg/BoundingBox3D", center=at, size=vector(0.0, 0.0)),
        id=name,
    )
