"""A recording as one mcap bag: the topics of the robot, and the truth as further topics."""

from collections.abc import Iterator, Mapping, Sequence
from heapq import merge
from itertools import groupby
from pathlib import Path
from typing import TypeAlias

import numpy as np

from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.formats.durable import replaced
from graph_slam_ros.graph.geometry import Geometry
from graph_slam_ros.lie import se3
from graph_slam_ros.messages.to_msg import (
    covariance6,
    detections,
    encode,
    header,
    make,
    odometry,
    pose_stamped,
    quaternion,
    transform,
    vector,
)
from graph_slam_ros.recordings.bag import BagWriter
from graph_slam_ros.slam import Sighting, Sightings
from graph_slam_ros.tools.simulation.recording import CLOSURES_TOPIC, LANDMARKS_TOPIC, Gnss, Imu, Recording, space_of
from graph_slam_ros.typing import Numbers

Message: TypeAlias = tuple[str, str, int, bytes]
"""Topic, type, stamp [ns] and CDR bytes."""

GNSS_TOPIC, IMU_TOPIC = "/gps/fix", "/imu/data"
GNSS_FRAME, IMU_FRAME = "gps", "imu_link"
_FIX, _NO_FIX, _GPS, _DIAGONAL_KNOWN = 0, -1, 1, 2


def gnss_messages(gnss: Gnss | None) -> Iterator[Message]:
    """sensor_msgs/NavSatFix in order of stamp. Without a fix, latitude, longitude and height are NaN."""
    if gnss is None:
        return
    yield _mounted(int(gnss.stamps_ns[0]), GNSS_FRAME, (*gnss.antenna, 0.0, 0.0, 0.0, 1.0))
    name = "sensor_msgs/msg/NavSatFix"
    for stamp_ns, where, has_fix in zip(gnss.stamps_ns.tolist(), gnss.geodetic.tolist(), gnss.has_fix, strict=True):
        latitude, longitude, altitude = where if has_fix else (np.nan,) * 3
        message = make(
            name,
            header=header(stamp_ns, GNSS_FRAME),
            status=make("sensor_msgs/msg/NavSatStatus", status=_FIX if has_fix else _NO_FIX, service=_GPS),
            latitude=latitude,
            longitude=longitude,
            altitude=altitude,
            position_covariance=gnss.covariance.ravel() if has_fix else np.zeros(9),
            position_covariance_type=_DIAGONAL_KNOWN if has_fix else 0,
        )
        yield GNSS_TOPIC, name, stamp_ns, encode(message)


def imu_messages(imu: Imu | None) -> Iterator[Message]:
    """sensor_msgs/Imu in order of stamp. The covariances of rates and accelerations are unknown."""
    if imu is None:
        return
    yield _mounted(int(imu.stamps_ns[0]), IMU_FRAME, imu.T_base_imu)
    name = "sensor_msgs/msg/Imu"
    for k, stamp_ns in enumerate(imu.stamps_ns.tolist()):
        message = make(
            name,
            header=header(stamp_ns, IMU_FRAME),
            orientation=quaternion(*imu.orientation[k].tolist()),
            orientation_covariance=imu.covariance.ravel(),
            angular_velocity=vector(*imu.rate[k].tolist()),
            angular_velocity_covariance=np.zeros(9),
            linear_acceleration=vector(*imu.acceleration[k].tolist()),
            linear_acceleration_covariance=np.zeros(9),
        )
        yield IMU_TOPIC, name, stamp_ns, encode(message)


def _mounted(stamp_ns: int, frame: str, T_base_frame: Numbers) -> Message:
    return "/tf_static", _TRANSFORMS, stamp_ns, transform(stamp_ns, "base_link", frame, T_base_frame)


ODOMETRY_TOPIC = "/odom"
TRUTH_TOPIC = "/ground_truth"
TRUE_LANDMARKS_TOPIC = "/landmarks_ground_truth"
_TRANSFORMS = "tf2_msgs/msg/TFMessage"
_DETECTIONS = "vision_msgs/msg/Detection3DArray"
_POINTS = "sensor_msgs/msg/PointCloud2"
_SENSOR, _CAMERA = "sensor", "camera_optical_frame"
_T_BASE_CAMERA = se3.from_xyz_rpy((0.2, 0.0, 0.4, -0.5 * np.pi, 0.0, -0.5 * np.pi))  # it looks ahead
_UNUSED = 1e6  # variance of what is not measured: z, roll, pitch of a planar robot, the rotation of a point
_SURVEYED_M = 1e-3  # truth has no error; a covariance of zero would mean unknown


def write_bag(recording: Recording, path: Path | str) -> None:
    """Write a bag in order of stamp, whole or not at all.

    ``/odom`` nav_msgs/Odometry (odom, base_link), ``/landmarks`` vision_msgs/Detection3DArray (base_link),
    ``/ground_truth`` geometry_msgs/PoseStamped and, once, ``/landmarks_ground_truth`` Detection3DArray (world); where
    there are closures, ``/closures`` Detection3DArray (base_link), as an input of ``use: closure`` takes them.

    Ranges and bearings are sensor_msgs/PointCloud2 instead, with the fields ``id``, ``range``, ``bearing``,
    ``elevation``, ``sigma`` and ``sigma_bearing``, as far as they are measured, in the frame ``sensor`` of
    ``/tf_static``. A field holds no name: landmarks then go by their numbers, in the truth, too.

    Tags of ``apriltag`` are transforms on ``/tf`` from ``camera_optical_frame`` to ``tag36h11:7`` and so on.

    A satellite receiver is on ``/gps/fix`` (NavSatFix, frame ``gps``), an IMU on ``/imu/data`` (Imu, ``imu_link``).

    Raises
    ------
    GraphSlamError
        What is seen is of kinds that no one message has.
    """
    if _is_polar(recording) and len(_kinds(recording)) > 1:
        raise GraphSlamError(f"no message holds {' and '.join(sorted(_kinds(recording)))} together")
    if recording.apriltag and _kinds(recording) != {"pose"}:
        raise GraphSlamError("apriltag: it publishes poses of tags: a world with sensor=pose")
    streams = [
        _mounted_sensor(recording),
        gnss_messages(recording.gnss),
        imu_messages(recording.imu),
        _odometry(recording),
        _landmarks(recording),
        _closures(recording),
        _truth(recording),
        _true_landmarks(recording),
    ]
    with replaced(Path(path)) as new, BagWriter(new) as bag:
        for message in merge(*streams, key=lambda message: message[2]):
            bag.write(*message)


def recorded_names(recording: Recording) -> dict[str, str]:
    """Return the name of each landmark in a bag: its id, or a number if the messages have no names."""
    if not (recording.apriltag or _is_polar(recording)):
        return {name: name for name in recording.landmarks}
    return {name: f"{'tag36h11:' * recording.apriltag}{k}" for k, name in enumerate(recording.landmarks)}


def _kinds(recording: Recording) -> set[str]:
    return {s.kind for one in recording.seen for s in one.sightings}


def _is_polar(recording: Recording) -> bool:
    return bool(_kinds(recording) - {"position", "pose"})


def _mounted_sensor(recording: Recording) -> Iterator[Message]:
    if recording.apriltag:
        yield _mounted(int(recording.stamps_ns[0]), _CAMERA, _T_BASE_CAMERA)
    if _is_polar(recording):
        T_base_sensor = next(s.T_base_sensor for one in recording.seen for s in one.sightings)
        at = T_base_sensor or space_of(recording.T_world_base[0]).identity
        yield _mounted(int(recording.stamps_ns[0]), _SENSOR, at)


def _odometry(recording: Recording) -> Iterator[Message]:
    twists = np.zeros((len(recording.twist), 42))
    twists[:, [0, 1, 5] if recording.twist.shape[1] == 3 else slice(6)] = recording.twist
    twists[:, 6:] = covariance6(recording.twist_covariance, _UNUSED)
    poses, covariances = recording.T_odom_base.tolist(), recording.odom_covariance
    for stamp_ns, at, covariance, twist in zip(recording.stamps_ns.tolist(), poses, covariances, twists, strict=True):
        cdr = odometry(stamp_ns, "odom", "base_link", tuple(at), covariance, _UNUSED, twist.tobytes())
        yield ODOMETRY_TOPIC, "nav_msgs/msg/Odometry", stamp_ns, cdr


def _truth(recording: Recording) -> Iterator[Message]:
    for stamp_ns, pose in zip(recording.stamps_ns.tolist(), recording.T_world_base.tolist(), strict=True):
        truth = pose_stamped(stamp_ns, "world", tuple(pose))
        yield TRUTH_TOPIC, "geometry_msgs/msg/PoseStamped", stamp_ns, truth


def _true_landmarks(recording: Recording) -> Iterator[Message]:
    """The true map, as sightings from the origin of the world."""
    space, names, known = space_of(recording.T_world_base[0]), recorded_names(recording), []
    for name, at in recording.landmarks.items():
        kind, dof = ("pose", space.dof) if len(at) == space.pose.size else ("position", space.dimensions)
        known.append(Sighting(names[name], kind, at, tuple((_SURVEYED_M**2 * np.eye(dof)).ravel().tolist())))
    yield _detections(TRUE_LANDMARKS_TOPIC, int(recording.stamps_ns[0]), "world", known, space)


def _landmarks(recording: Recording) -> Iterator[Message]:
    space, names, is_polar = space_of(recording.T_world_base[0]), recorded_names(recording), _is_polar(recording)
    to_camera = se3.inverse(_T_BASE_CAMERA)
    for one in recording.seen:
        if recording.apriltag:
            for tag in one.sightings:
                at = se3.compose(to_camera, tuple(se3.in_space(tag.measured).tolist()))
                yield "/tf", _TRANSFORMS, one.stamp_ns, transform(one.stamp_ns, _CAMERA, names[tag.id], at)
        elif is_polar:
            yield LANDMARKS_TOPIC, _POINTS, one.stamp_ns, _point_cloud(one, names)
        else:
            yield _detections(LANDMARKS_TOPIC, one.stamp_ns, "base_link", one.sightings, space)


def _closures(recording: Recording) -> Iterator[Message]:
    """Earlier poses of the base relative to the later ones: a motion ``d`` of a pose is ``-Ad d`` of its inverse."""
    space = space_of(recording.T_world_base[0])
    for stamp_ns, several in groupby(recording.closures, key=lambda closure: closure.stamp_ns):
        seen = []
        for one in several:
            back = space.group.adjoint(one.T_from_base)
            covariance = back @ np.reshape(one.covariance, (space.dof, space.dof)) @ back.T
            measured = tuple(float(number) for number in space.group.inverse(one.T_from_base))
            seen.append(Sighting(str(one.from_stamp_ns), "pose", measured, tuple(covariance.ravel().tolist())))
        yield _detections(CLOSURES_TOPIC, stamp_ns, "base_link", seen, space)


def _detections(topic: str, stamp_ns: int, frame: str, seen: Sequence[Sighting], space: Geometry) -> Message:
    poses, covariances = np.tile(space.identity, (len(seen), 1)), np.empty((len(seen), 36))
    for s, pose, row in zip(seen, poses, covariances, strict=True):
        pose[: len(s.measured)] = s.measured
        known, covariance = space.dof if s.kind == "pose" else space.dimensions, _UNUSED * np.eye(space.dof)
        covariance[:known, :known] = np.reshape(s.covariance, (known, known))
        row[:] = covariance6(space.in_parent_axes(tuple(pose), covariance), _UNUSED)
    cdr = detections(stamp_ns, frame, [s.id for s in seen], se3.in_space(poses), covariances)
    return topic, _DETECTIONS, stamp_ns, cdr


def _point_cloud(seen: Sightings, names: Mapping[str, str]) -> bytes:
    """A PointCloud2 of doubles, a point for each sighting; its sigmas are the roots of the variances."""
    kind = seen.sightings[0].kind
    angles = ("bearing", "elevation")[: len(seen.sightings[0].measured) - ("range" in kind)]
    measured = ("range", *angles) if "range" in kind else angles
    sigmas = ("sigma", "sigma_bearing") if kind == "range_bearing" else ("sigma",)
    rows = []
    for s in seen.sightings:
        variances = np.reshape(s.covariance, (len(measured), -1)).diagonal()
        rows.append([int(names[s.id]), *s.measured, *np.sqrt(variances[: len(sigmas)])])
    points = np.array(rows, dtype="<f8")
    fields = [
        make("sensor_msgs/msg/PointField", name=name, offset=8 * k, datatype=8, count=1)
        for k, name in enumerate(("id", *measured, *sigmas))
    ]
    message = make(
        _POINTS,
        header=header(seen.stamp_ns, _SENSOR),
        height=1,
        width=len(points),
        fields=fields,
        is_bigendian=False,
        point_step=8 * len(fields),
        row_step=points.nbytes,
        data=points.ravel().view(np.uint8),
        is_dense=True,
    )
    return encode(message)
