"""Messages of a satellite receiver and an IMU, with the transforms that tell where they are."""

from collections.abc import Iterator
from typing import TypeAlias

import numpy as np

from graph_slam_ros.messages.to_msg import encode, header, make, quaternion, transform, vector
from graph_slam_ros.simulation.recording import Gnss, Imu
from graph_slam_ros.typing import Numbers

Message: TypeAlias = tuple[str, str, int, bytes]
"""Topic, type, stamp [ns] and CDR bytes."""

GNSS_TOPIC, IMU_TOPIC = "/gps/fix", "/imu/data"
GNSS_FRAME, IMU_FRAME = "gps", "imu_link"
_FIX, _NO_FIX, _GPS, _DIAGONAL_KNOWN = 0, -1, 1, 2


def gnss_messages(gnss: Gnss | None) -> Iterator[Message]:
    """sensor_msgs/NavSatFix in order of stamp; without a fix latitude, longitude and height are NaN."""
    if gnss is None:
        return
    if gnss.antenna is not None:
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
    """sensor_msgs/Imu in order of stamp; of rates and accelerations the covariance is unknown."""
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
    return "/tf_static", "tf2_msgs/msg/TFMessage", stamp_ns, transform(stamp_ns, "base_link", frame, T_base_frame)
