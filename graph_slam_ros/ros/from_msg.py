"""The border: a message comes in as CDR bytes and leaves as a measurement, or is counted and refused.

Works on the bytes of live subscriptions and of bags alike; needs no ROS. Every refusal and every repair adds to a
counter by (source, reason).
"""

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from graph_slam_ros.lie import se2
from graph_slam_ros.ros.interfaces import typestore
from graph_slam_ros.ros.transforms import StaticTransforms, matrix, rotation_matrix
from graph_slam_ros.slam.config import Config
from graph_slam_ros.slam.counters import Counters
from graph_slam_ros.slam.measurements import Odometry, Sighting, Sightings

Array = NDArray[np.float64]
Decoder = Callable[[bytes], Any]

ODOMETRY = "nav_msgs/msg/Odometry"
DETECTIONS = "vision_msgs/msg/Detection3DArray"
TRANSFORMS = "tf2_msgs/msg/TFMessage"

_PLANAR = np.ix_([0, 1, 5], [0, 1, 5])
_NORM_REPAIRED = 0.1  # a quaternion this far from unit length is normalised, beyond it is refused
_NORM_EXACT = 1e-6
_ASYMMETRY_REPAIRED, _ASYMMETRY_EXACT = 1e-2, 1e-6
_DEFICIT_REPAIRED = 1e-9  # negative eigenvalues down to this fraction of the largest are rounding
_AGREE_SIGMA = 3.0
_FARTHEST_M = 1e9
_MOST_VARIANCE = np.array([1e6, 1e6, 1e3])  # m^2, m^2, rad^2: as good as unknown; drivers send up to 1.8e308


class MessageError(Exception):
    """A message, or one item of it, that is refused; its text is the reason it is counted under."""


def decoder(type_name: str) -> Decoder:
    """From CDR bytes to a message object of our own type store."""
    store = typestore()
    return lambda cdr: store.deserialize_cdr(cdr, type_name)


class Border:
    """Turns messages into measurements.

    Parameters
    ----------
    config : frames and the defaults for what messages leave unknown
    counters : where refusals and repairs are counted
    decoders : by message type, where a recording's own definition is to be used instead of ours
    """

    def __init__(self, config: Config, counters: Counters, decoders: Mapping[str, Decoder] | None = None) -> None:
        self._config = config
        self._counters = counters
        self._decode = {name: decoder(name) for name in (ODOMETRY, DETECTIONS, TRANSFORMS)} | dict(decoders or {})
        self._transforms = StaticTransforms()
        self._twist_bytes = b""  # drivers repeat the same covariance
        self._twist: tuple[tuple[str, ...], tuple[float, ...] | None] = ((), None)

    # -- one message each --------------------------------------------------------------------------------------------

    def odometry(self, cdr: bytes) -> Odometry | None:
        """nav_msgs/Odometry."""
        try:
            return self._odometry(self._decoded(ODOMETRY, cdr))
        except MessageError as reason:
            self._counters.count("odometry", str(reason))
            return None

    def sightings(self, topic: str, cdr: bytes) -> Sightings | None:
        """vision_msgs/Detection3DArray; None where nothing of it can be used."""
        try:
            message = self._decoded(DETECTIONS, cdr)
            stamp_ns = _stamp_ns(message.header.stamp)
        except MessageError as reason:
            self._counters.count(topic, str(reason))
            return None
        seen = []
        for detection in message.detections:
            try:
                seen.append(self._sighting(topic, detection, message.header.frame_id))
            except MessageError as reason:
                self._counters.count(topic, str(reason))
        usable = self._agreed(topic, seen)
        return Sightings(stamp_ns, topic, tuple(usable)) if usable else None

    def static_transforms(self, cdr: bytes) -> None:
        """tf2_msgs/TFMessage of /tf_static."""
        try:
            message = self._decoded(TRANSFORMS, cdr)
        except MessageError as reason:
            self._counters.count("tf_static", str(reason))
            return
        for t in message.transforms:
            try:
                self._finite(t.transform.translation)
                self._unit("tf_static", t.transform.rotation)
                parent = self._frame("tf_static", t.header.frame_id)
                child = self._frame("tf_static", t.child_frame_id)
            except MessageError as reason:
                self._counters.count("tf_static", str(reason))
                continue
            self._transforms.add(parent, child, matrix(t.transform.translation, t.transform.rotation))

    # -- odometry ----------------------------------------------------------------------------------------------------

    def _odometry(self, m: Any) -> Odometry:
        stamp_ns = _stamp_ns(m.header.stamp)
        frames = self._config.frames
        position, q = m.pose.pose.position, m.pose.pose.orientation
        self._finite(position)
        self._unit("odometry", q)
        parent = self._frame("odometry", m.header.frame_id)
        child = self._frame("odometry", m.child_frame_id)
        if parent == frames.odom and child == frames.base:
            at: se2.Pose = (float(position.x), float(position.y), _yaw(q))
        else:
            T_odom_parent = self._linked(frames.odom, parent, "frame_unknown")
            T_child_base = self._linked(child, frames.base, "child_frame_unknown")
            at = _planar(T_odom_parent @ matrix(position, q) @ T_child_base)
        return Odometry(stamp_ns, at, self._twist_covariance(m.twist.covariance, child))

    def _twist_covariance(self, flat: Array, child: str) -> tuple[float, ...] | None:
        if self._config.odometry.noise != "twist" or child != self._config.frames.base:
            return None  # not used, or it belongs to another point of the robot
        raw = flat.tobytes()
        if raw != self._twist_bytes:
            repairs, checked = self._checked(flat.reshape(6, 6)[_PLANAR])
            self._twist_bytes = raw
            self._twist = repairs, None if checked is None else tuple(checked.ravel().tolist())
        repairs, covariance = self._twist
        for repair in repairs:
            self._counters.count("odometry", repair)
        if covariance is None and "covariance_unknown" not in repairs:
            raise MessageError(_refusal(flat.reshape(6, 6)[_PLANAR]))
        return covariance

    # -- landmarks ---------------------------------------------------------------------------------------------------

    def _sighting(self, topic: str, detection: Any, array_frame: str) -> Sighting:
        name = self._identity(detection)
        frame = self._frame(topic, detection.header.frame_id or array_frame)
        if detection.results:
            seen, flat = detection.results[0].pose.pose, detection.results[0].pose.covariance
        else:
            seen, flat = detection.bbox.center, np.zeros(36)
        self._finite(seen.position)
        T_base_sensor = self._linked(self._config.frames.base, frame, "frame_unknown")
        turn = T_base_sensor[:3, :3]
        x, y, _ = (turn @ (seen.position.x, seen.position.y, seen.position.z) + T_base_sensor[:3, 3]).tolist()
        if not np.isfinite(flat).all():
            raise MessageError("nonfinite_covariance")
        both = np.kron(np.eye(2), turn)
        full = both @ flat.reshape(6, 6) @ both.T
        yaw = self._known_heading(topic, seen.orientation, turn, full)
        if yaw is None:
            covariance = self._landmark_covariance(topic, full[:2, :2])
            return Sighting(name, "position", (x, y), tuple(covariance.ravel().tolist()))
        into = se2.adjoint((0.0, 0.0, -yaw))  # from the base's axes to the landmark's
        covariance = into @ self._landmark_covariance(topic, full[_PLANAR]) @ into.T
        return Sighting(name, "pose", (x, y, yaw), tuple(covariance.ravel().tolist()))

    def _identity(self, detection: Any) -> str:
        if self._config.landmarks.id_from == "class_id":
            name = detection.results[0].hypothesis.class_id if detection.results else ""
        else:
            name = detection.id
        if not name:
            raise MessageError("no_id")
        if len(name.encode()) > 128:
            raise MessageError("id_too_long")
        return str(name)

    def _known_heading(self, topic: str, q: Any, turn: Array, covariance: Array) -> float | None:
        """Heading of the landmark in the base frame where it was observed and is defined, else None."""
        variance = covariance[5, 5]
        if not 0.0 < variance < self._config.landmarks.orientation_known_below_rad**2:
            return None
        self._unit(topic, q)
        ahead = turn @ rotation_matrix(q)[:, 0]
        if ahead[0] ** 2 + ahead[1] ** 2 < 0.25:  # its x axis points up: no heading in the plane
            return None
        return math.atan2(ahead[1], ahead[0])

    def _landmark_covariance(self, topic: str, block: Array) -> Array:
        repairs, covariance = self._checked(block)
        if len(block) == 3 and not block[:2, :2].any():  # only the heading's variance is given
            sigma_m = self._config.landmarks.sigma_m
            repairs, covariance = ("covariance_unknown",), np.diag([sigma_m**2, sigma_m**2, block[2, 2]])
        for repair in repairs:
            self._counters.count(topic, repair)
        if covariance is not None:
            return covariance
        if "covariance_unknown" in repairs:
            return np.eye(len(block)) * self._config.landmarks.sigma_m**2
        raise MessageError(_refusal(block))

    def _agreed(self, topic: str, seen: list[Sighting]) -> list[Sighting]:
        """One sighting per id: repeats that agree within 3 sigma are merged, others are all dropped."""
        by_id: dict[str, list[Sighting]] = {}
        for one in seen:
            by_id.setdefault(one.id, []).append(one)
        out = []
        for same in by_id.values():
            merged = same[0]
            for other in same[1:]:
                fused = _merge(merged, other)
                if fused is None:
                    self._counters.count(topic, "id_conflict", len(same))
                    break
                merged = fused
            else:
                if len(same) > 1:
                    self._counters.count(topic, "id_merged", len(same) - 1)
                out.append(merged)
        return out

    # -- checks ------------------------------------------------------------------------------------------------------

    def _decoded(self, type_name: str, cdr: bytes) -> Any:
        try:
            return self._decode[type_name](cdr)
        except Exception:  # of damaged bytes rosbags raises struct, index, unicode and assertion errors
            raise MessageError("undecodable") from None

    def _frame(self, source: str, name: str) -> str:
        if name.startswith("/"):
            self._counters.count(source, "frame_slash_stripped")
            name = name[1:]
        if not name:
            raise MessageError("frame_empty")
        return name

    def _linked(self, target: str, source: str, reason: str) -> Array:
        found = np.eye(4) if target == source else self._transforms.lookup(target, source)
        if found is None:
            raise MessageError(reason)
        return found

    @staticmethod
    def _finite(v: Any) -> None:
        if not (math.isfinite(v.x) and math.isfinite(v.y) and math.isfinite(v.z)):
            raise MessageError("nonfinite")
        if max(abs(v.x), abs(v.y), abs(v.z)) > _FARTHEST_M:
            raise MessageError("too_far")

    def _unit(self, source: str, q: Any) -> None:
        """Refuse what is no rotation; bring a nearly unit quaternion to unit length, in place."""
        norm = math.sqrt(q.x * q.x + q.y * q.y + q.z * q.z + q.w * q.w)
        if abs(norm - 1.0) <= _NORM_EXACT:
            return
        if not math.isfinite(norm):
            raise MessageError("nonfinite")
        if norm == 0.0:
            raise MessageError("zero_quaternion")
        if abs(norm - 1.0) > _NORM_REPAIRED:
            raise MessageError("denormal_quaternion")
        self._counters.count(source, "quaternion_normalized")
        q.x, q.y, q.z, q.w = q.x / norm, q.y / norm, q.z / norm, q.w / norm

    @staticmethod
    def _checked(block: Array) -> tuple[tuple[str, ...], Array | None]:
        """(repairs, covariance): symmetric positive definite, or None where it is unknown or must be refused."""
        if not block.any():
            return ("covariance_unknown",), None
        if not np.isfinite(block).all():
            return (), None
        repairs = []
        variances, most = np.diag(block), _MOST_VARIANCE[: len(block)]
        if (variances > most).any():
            repairs.append("covariance_clamped")
            scale = np.sqrt(most / np.maximum(variances, most))
            block = scale[:, None] * block * scale
        asymmetry = np.abs(block - block.T).max() / np.abs(block).max()
        if asymmetry > _ASYMMETRY_REPAIRED:
            return (), None
        if asymmetry > _ASYMMETRY_EXACT:
            repairs.append("covariance_symmetrized")
        symmetric = 0.5 * block + 0.5 * block.T
        values, vectors = np.linalg.eigh(symmetric)
        floor = _DEFICIT_REPAIRED * values[-1]
        if values[0] < -floor or values[-1] <= 0.0:
            return (), None
        if values[0] < 1e-3 * floor:
            repairs.append("covariance_floored")
            symmetric = (vectors * np.maximum(values, floor)) @ vectors.T
        return tuple(repairs), symmetric


def _refusal(block: Array) -> str:
    if not np.isfinite(block).all():
        return "nonfinite_covariance"
    if np.abs(block - block.T).max() > _ASYMMETRY_REPAIRED * np.abs(block).max():
        return "covariance_asymmetric"
    return "covariance_not_positive_definite"


def _stamp_ns(stamp: Any) -> int:
    if stamp.sec < 0 or not 0 <= stamp.nanosec < 1_000_000_000:
        raise MessageError("bad_stamp")
    stamp_ns = stamp.sec * 1_000_000_000 + stamp.nanosec
    if stamp_ns == 0:
        raise MessageError("zero_stamp")
    return int(stamp_ns)


def _yaw(q: Any) -> float:
    return math.atan2(2.0 * (q.w * q.z + q.x * q.y), 1.0 - 2.0 * (q.y * q.y + q.z * q.z))


def _planar(T: Array) -> se2.Pose:
    return float(T[0, 3]), float(T[1, 3]), math.atan2(T[1, 0], T[0, 0])


def _merge(a: Sighting, b: Sighting) -> Sighting | None:
    """Information-weighted mean of two sightings that agree, else None."""
    if a.kind != b.kind:
        return None
    m = len(a.measured)
    difference = np.subtract(b.measured, a.measured)
    if m == 3:
        difference = np.array(se2.local(b.measured, a.measured))
    cov_a, cov_b = np.array(a.covariance).reshape(m, m), np.array(b.covariance).reshape(m, m)
    gain = cov_a @ np.linalg.inv(cov_a + cov_b)
    if difference @ np.linalg.solve(cov_a + cov_b, difference) > _AGREE_SIGMA**2:
        return None
    if a == b:
        return a
    step = gain @ difference
    at = np.add(a.measured, step).tolist() if m == 2 else se2.retract(a.measured, tuple(step.tolist()))
    merged = cov_a - gain @ cov_a
    return Sighting(a.id, a.kind, tuple(map(float, at)), tuple((0.5 * (merged + merged.T)).ravel().tolist()))
