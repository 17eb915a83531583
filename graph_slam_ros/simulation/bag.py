"""A recording as one mcap bag: what a robot would have recorded, and the truth beside it."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.ros.bag import BagWriter
from graph_slam_ros.ros.to_msg import covariance6, encode, header, make, pose_stamped, pose_with_covariance, vector
from graph_slam_ros.simulation.motion import space_of
from graph_slam_ros.simulation.recording import LANDMARKS_TOPIC, Recording
from graph_slam_ros.slam import Sighting, Sightings
from graph_slam_ros.slam.space import Space

Array = NDArray[np.float64]

ODOMETRY_TOPIC = "/odom"
TRUTH_TOPIC = "/ground_truth"
TRUE_LANDMARKS_TOPIC = "/landmarks_ground_truth"
_DETECTIONS = "vision_msgs/msg/Detection3DArray"
_UNUSED = 1e6  # variance of what is not measured: z, roll, pitch of a planar robot, the rotation of a point
_SURVEYED_M = 1e-3  # truth has no error; a covariance of zero would mean unknown


def write_bag(recording: Recording, path: Path | str) -> None:
    """Write a bag in order of stamp.

    ``/odom`` nav_msgs/Odometry (odom, base_link), ``/landmarks`` vision_msgs/Detection3DArray (base_link),
    ``/ground_truth`` geometry_msgs/PoseStamped and, once, ``/landmarks_ground_truth`` Detection3DArray (world).

    Raises
    ------
    GraphSlamError
        The sensor says what a detection cannot: a range or a bearing. Nothing was written.
    """
    kinds = {s.kind for seen in recording.seen for s in seen.sightings} - {"position", "pose"}
    if kinds:
        raise GraphSlamError(f"no message of a bag says {kinds.pop()}: only positions and poses can be recorded")
    space, seen = space_of(recording.T_world_base[0]), {s.stamp_ns: s for s in recording.seen}
    twist_covariance = covariance6(recording.twist_covariance, _UNUSED)
    with BagWriter(path) as bag:
        first_ns = int(recording.stamps_ns[0])
        for k, stamp_ns in enumerate(recording.stamps_ns.tolist()):
            bag.write(ODOMETRY_TOPIC, "nav_msgs/msg/Odometry", stamp_ns, _odometry(recording, k, twist_covariance))
            if stamp_ns in seen:
                bag.write(LANDMARKS_TOPIC, _DETECTIONS, stamp_ns, _detections(seen[stamp_ns], "base_link", space))
            truth = pose_stamped(stamp_ns, "world", tuple(recording.T_world_base[k].tolist()))
            bag.write(TRUTH_TOPIC, "geometry_msgs/msg/PoseStamped", stamp_ns, truth)
            if stamp_ns == first_ns:
                true = _detections(_true_landmarks(recording, space), "world", space)
                bag.write(TRUE_LANDMARKS_TOPIC, _DETECTIONS, stamp_ns, true)


def _odometry(recording: Recording, k: int, twist_covariance: Array) -> bytes:
    at, velocity = tuple(recording.T_odom_base[k].tolist()), recording.twist[k].tolist()
    if len(velocity) == 3:
        velocity = [velocity[0], velocity[1], 0.0, 0.0, 0.0, velocity[2]]
    twist = make("geometry_msgs/msg/Twist", linear=vector(*velocity[:3]), angular=vector(*velocity[3:]))
    message = make(
        "nav_msgs/msg/Odometry",
        header=header(int(recording.stamps_ns[k]), "odom"),
        child_frame_id="base_link",
        pose=pose_with_covariance(at, recording.odom_covariance[k], _UNUSED),
        twist=make("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=twist_covariance),
    )
    return encode(message)


def _true_landmarks(recording: Recording, space: Space) -> Sightings:
    """The true map, as sightings from the origin of world."""
    known = []
    for name, at in recording.landmarks.items():
        kind, dof = ("pose", space.dof) if len(at) == space.pose.size else ("position", space.dimensions)
        known.append(Sighting(name, kind, at, tuple((_SURVEYED_M**2 * np.eye(dof)).ravel().tolist())))
    return Sightings(int(recording.stamps_ns[0]), TRUE_LANDMARKS_TOPIC, tuple(known))


def _detections(seen: Sightings, frame: str, space: Space) -> bytes:
    head = header(seen.stamp_ns, frame)
    return encode(make(_DETECTIONS, header=head, detections=[_detection(head, s, space) for s in seen.sightings]))


def _detection(head: Any, s: Sighting, space: Space) -> Any:
    known = space.dof if s.kind == "pose" else space.dimensions
    covariance = _UNUSED * np.eye(space.dof)
    covariance[:known, :known] = np.reshape(s.covariance, (known, known))
    posed = pose_with_covariance((*s.measured, *space.identity[len(s.measured) :]), covariance, _UNUSED)
    hypothesis = make("vision_msgs/msg/ObjectHypothesis", class_id=s.id, score=1.0)
    return make(
        "vision_msgs/msg/Detection3D",
        header=head,
        results=[make("vision_msgs/msg/ObjectHypothesisWithPose", hypothesis=hypothesis, pose=posed)],
        bbox=make("vision_msgs/msg/BoundingBox3D", center=posed.pose, size=vector(0.0, 0.0)),
        id=s.id,
    )
