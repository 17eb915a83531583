"""The types of messages that can be inputs: their uses, converters, and the fields that are read.

A new type of landmarks is a row of ``LANDMARK_TYPES``, and a generator in ``detections`` or ``ranges`` where ``marks``
does not read it: all else is made of the row.

A converter is a function of an input (``InputContext``) and a message. It raises ``MessageError`` to refuse the whole
message, and ``NotYet`` if a transform is missing that may still come.
"""

from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from difflib import get_close_matches
from functools import partial
from typing import Any

from graph_slam_ros.config.config import Config
from graph_slam_ros.config.inputs import InputConfig
from graph_slam_ros.errors import ConfigError
from graph_slam_ros.measurements.types import Measured
from graph_slam_ros.messages.inputs import detections, fixes, odometry, plugins, ranges
from graph_slam_ros.messages.inputs.checks import MessageError
from graph_slam_ros.messages.inputs.landmarks import ObservedLandmark, sightings
from graph_slam_ros.messages.inputs.plugins import InputType
from graph_slam_ros.messages.inputs.source import InputContext, NotYet

__all__ = [
    "APRILTAGS",
    "CONVERTERS",
    "LANDMARK_TYPES",
    "InputContext",
    "InputType",
    "MessageError",
    "NotYet",
    "ObservedLandmark",
    "check_topics",
    "converters",
    "known_types",
    "recorded_uses",
    "uses",
]

_CLOSE = 0.8  # of 1

Converter = Callable[[InputContext, Any], Iterable[Measured]]


@dataclass(frozen=True, slots=True)
class LandmarkType:
    """A type of landmark messages, and its reader.

    Attributes
    ----------
    input_name : what ``graph_slam info`` calls an input of this type
    read : yields one ``ObservedLandmark`` for each landmark of a message
    fields : the fields that ``read`` uses, of the message and of its parts from the same package
    """

    input_name: str
    read: Callable[[InputContext, Any], Iterable[ObservedLandmark]]
    fields: str


def _marks(*things: str) -> LandmarkType:
    """Tags in arrays, of each the fields: the array, and in it identity and pose."""
    read = partial(detections.marks, [one.split() for one in things])
    return LandmarkType("tags", read, " ".join(("header", *things)))


APRILTAGS = "apriltag_msgs/msg/AprilTagDetectionArray"
_APRILTAGS = "header detections family id hamming decision_margin"
_WEIGHED = "header landmarks id tracking_from_landmark_transform translation_weight rotation_weight"
_BEACON = "header sensor_pose_on_robot sensor_std_range sensed_data range id"

LANDMARK_TYPES: Mapping[str, LandmarkType] = {
    APRILTAGS: LandmarkType("tags", detections.apriltags, _APRILTAGS),
    "isaac_ros_apriltag_interfaces/msg/AprilTagDetectionArray": _marks("detections id pose"),
    "apriltag_ros/msg/AprilTagDetectionArray": _marks("detections id pose"),
    "apriltags_ros/msg/AprilTagDetectionArray": _marks("detections id pose"),
    "ar_track_alvar_msgs/msg/AlvarMarkers": _marks("markers id pose"),
    "aruco_msgs/msg/MarkerArray": _marks("markers id pose"),
    "aruco_markers_msgs/msg/MarkerArray": _marks("markers id pose"),
    "ros2_aruco_interfaces/msg/ArucoMarkers": LandmarkType("tags", detections.ros2_aruco, "header marker_ids poses"),
    "aruco_opencv_msgs/msg/ArucoDetection": _marks("markers marker_id pose", "boards board_name pose"),
    "fiducial_msgs/msg/FiducialTransformArray": _marks("transforms fiducial_id transform"),
    "rtabmap_msgs/msg/LandmarkDetections": LandmarkType("tags", detections.rtabmap, "header landmarks id pose"),
    "cartographer_ros_msgs/msg/LandmarkList": LandmarkType("reflectors", detections.cartographer, _WEIGHED),
    "mrpt_msgs/msg/ObservationRangeBearing": LandmarkType(
        "beacons", ranges.mrpt, f"{_BEACON} sensor_std_yaw sensor_std_pitch yaw pitch"
    ),
    "mrpt_msgs/msg/ObservationRangeBeacon": LandmarkType("beacons", ranges.mrpt, _BEACON),
}


def _landmarks(read: Callable[[InputContext, Any], Iterable[ObservedLandmark]]) -> Converter:
    return lambda source, message: sightings(source, read(source, message))


_POSE: Mapping[str, Converter] = {
    "fix": fixes.pose_fix,
    "landmarks": _landmarks(detections.pose_stamped),
    "odometry": odometry.pose_stamped,
}

CONVERTERS: Mapping[str, Mapping[str, Converter]] = {
    "nav_msgs/msg/Odometry": {"odometry": odometry.odometry, "fix": fixes.pose_fix},
    "geometry_msgs/msg/PoseWithCovarianceStamped": _POSE,
    "geometry_msgs/msg/PoseStamped": _POSE,
    "tf2_msgs/msg/TFMessage": {"odometry": odometry.transforms, "landmarks": _landmarks(detections.transforms)},
    "sensor_msgs/msg/NavSatFix": {"fix": fixes.gnss},
    "sensor_msgs/msg/Imu": {"fix": fixes.imu, "gyro": odometry.angular_velocity},
    "vision_msgs/msg/Detection3DArray": {"landmarks": _landmarks(detections.detections), "closure": fixes.closures},
    "sensor_msgs/msg/PointCloud2": {"landmarks": _landmarks(ranges.point_cloud)},
    "visualization_msgs/msg/MarkerArray": {"landmarks": _landmarks(detections.markers)},
    **{name: {"landmarks": _landmarks(row.read)} for name, row in LANDMARK_TYPES.items()},
}
"""By type, then by use; the first use is that of ``auto``."""


def converters(type_name: str) -> Mapping[str, Converter] | None:
    """Return the converters of a type by use, from the table or from a plugin; None if neither has it.

    Raises
    ------
    ConfigError
        The plugin of the type cannot be used.
    """
    return CONVERTERS.get(type_name) or plugins.converters(type_name)


def known_types() -> set[str]:
    """Return the types that can be inputs, with those of installed plugins. No plugin is imported."""
    return {*CONVERTERS, *plugins.types()}


def uses(config: Config) -> dict[str, str]:
    """Return the use of each input by its name. Inputs that are not used are left out.

    Raises
    ------
    ConfigError
        An input of a type that neither the table nor a plugin has or that cannot be used so, or none is odometry, or
        odometry has a loss.
    """
    out = {settings.name: _use(settings) for settings in config.sources if settings.use != "none"}
    check_topics(config, out, {one.name: one.topic for one in config.sources})
    if "odometry" not in out.values():
        raise ConfigError(f"inputs.names: none of {config.inputs.names!r} is used as odometry (INPUT.use=odometry)")
    return out


def check_topics(config: Config, uses: Mapping[str, str], topics: Mapping[str, str]) -> None:
    """Check that no odometry is read twice. A topic of transforms may have several.

    Parameters
    ----------
    uses, topics : by the name of the input

    Raises
    ------
    ConfigError
        Two inputs read one topic as odometry.
    """
    reads: dict[str, str] = {}
    for one in config.sources:
        if uses.get(one.name) == "odometry" and one.name in topics and one.type != "tf2_msgs/msg/TFMessage":
            other = reads.setdefault(topics[one.name].strip("/"), one.name)
            if other != one.name:
                raise ConfigError(
                    f"{one.name}.topic: {topics[one.name]} is odometry by {other} already: name the topic of another "
                    f"odometry, or {one.name}.use=none"
                )


def recorded_uses(config: Config) -> dict[str, str]:
    """Return the use of each input of a recorded run, without inputs whose plugin is not installed here."""
    out = {}
    for settings in config.sources:
        with suppress(ConfigError):
            out[settings.name] = "" if settings.use == "none" else _use(settings)
    return out


def _use(settings: InputConfig) -> str:
    there = converters(settings.type)
    if not settings.type:
        of_use = [name for name, row in CONVERTERS.items() if settings.use in row]
        mend = of_use[0] if len(of_use) == 1 else "package/msg/Name"
        raise ConfigError(f"{settings.name}.type: it has none: {settings.name}.type={mend} (docs/inputs.md lists them)")
    if there is None:
        close = " or ".join(get_close_matches(settings.type, sorted(known_types()), 2, _CLOSE))
        remedy = f"is it {close}?" if close else "docs/inputs.md has a row for each, and no plugin reads it"
        raise ConfigError(f"{settings.name}.type: {settings.type!r} is no type of an input: {remedy}")
    use = next(iter(there)) if settings.use == "auto" else settings.use
    if use not in there:
        raise ConfigError(f"{settings.name}.use: {settings.type} can be {' or '.join(there)}, not {use}")
    if use == "odometry" and settings.loss != "auto":
        raise ConfigError(f"{settings.name}.loss: {settings.name} is used as odometry, which has no robust loss")
    return use
