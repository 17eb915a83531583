"""Checks of every message, whatever its type."""

import math
from functools import cache
from typing import Any, TypeVar

import numpy as np

from graph_slam_ros.formats.cdr import LATEST_NS, NS
from graph_slam_ros.lie import se2
from graph_slam_ros.measurements.edge_noise import LEAST_M2, LEAST_RAD2
from graph_slam_ros.typing import Array

_NORM_REPAIRED = 0.1  # a quaternion this far from unit length is normalised, beyond it is refused
_SQUARE_EXACT = 2e-6
_ASYMMETRY_REPAIRED, _ASYMMETRY_EXACT = 1e-2, 1e-6
_DEFICIT_REPAIRED = 1e-9  # negative eigenvalues down to this fraction of the largest are rounding
_FARTHEST_M = 1e9
_MOST_M2, _MOST_RAD2 = 1e6, 1e3  # as good as unknown; drivers send up to 1.8e308
_MOST_TURNED_RAD = 4.0 * math.pi  # a bearing that is farther from zero is no count of turns


Number = TypeVar("Number", bound=Any)


class MessageError(Exception):
    """A message, or one item of it, that is refused; its text is the reason it is counted under."""


# Of numbers, and of arrays of them.


def stamps_ns(sec: Number, nanosec: Number, offset_ns: int = 0) -> Number:
    """Nanoseconds of builtin_interfaces/Time, moved by an offset; 0 where it is no stamp."""
    out = sec * NS + nanosec + offset_ns
    is_stamp = (sec >= 0) & (nanosec >= 0) & (nanosec < NS) & ((sec > 0) | (nanosec > 0))
    return out * (is_stamp & (out > 0) & (out <= LATEST_NS))


def are_sound(x: Number, y: Number, z: Number) -> Any:
    """Return whether coordinates are finite, and of plausible size."""
    return (abs(x) <= _FARTHEST_M) & (abs(y) <= _FARTHEST_M) & (abs(z) <= _FARTHEST_M)


def are_units(x: Number, y: Number, z: Number, w: Number) -> Any:
    """Return whether a quaternion has unit length."""
    return abs(x * x + y * y + z * z + w * w - 1.0) <= _SQUARE_EXACT


# Of the parts of a message.


def stamp_ns(stamp: Any, offset_ns: int = 0) -> int:
    """Nanoseconds of a builtin_interfaces/Time, moved by an offset."""
    if out := stamps_ns(stamp.sec, stamp.nanosec, offset_ns):
        return int(out)
    raise MessageError("bad_stamp" if stamp.sec or stamp.nanosec else "zero_stamp")


def point(v: Any) -> tuple[float, float, float]:
    """Coordinates of a Point or Vector3."""
    if not are_sound(v.x, v.y, v.z):
        raise MessageError("too_far" if all(map(math.isfinite, (v.x, v.y, v.z))) else "nonfinite")
    return float(v.x), float(v.y), float(v.z)


def quaternion(q: Any) -> tuple[tuple[float, float, float, float], bool]:
    """Unit quaternion (x, y, z, w), and whether it had to be normalised."""
    if are_units(q.x, q.y, q.z, q.w):
        return (q.x, q.y, q.z, q.w), False
    norm = math.sqrt(q.x * q.x + q.y * q.y + q.z * q.z + q.w * q.w)
    if not math.isfinite(norm):
        raise MessageError("nonfinite")
    if norm == 0.0:
        raise MessageError("zero_quaternion")
    if abs(norm - 1.0) > _NORM_REPAIRED:
        raise MessageError("denormal_quaternion")
    return (q.x / norm, q.y / norm, q.z / norm, q.w / norm), True


def covariance(block: Array, lengths: int) -> tuple[Array, list[str]]:
    """Symmetric positive definite, and how it was repaired.

    Parameters
    ----------
    block : (n, n)
    lengths : how many of its variances are in m^2; the others are in rad^2
    """
    if not np.isfinite(block).all():
        raise MessageError("nonfinite_covariance")
    if not block.any():
        raise MessageError("covariance_not_positive_definite")
    repairs = []
    variances, (most, least) = block.diagonal(), _bounds(len(block), lengths)
    if (variances > most).any():
        repairs.append("covariance_clamped")
        scale = np.sqrt(most / np.maximum(variances, most))
        block = scale[:, None] * block * scale
    is_tiny = (variances >= 0.0) & (variances < least)
    has_tiny = bool(is_tiny.any())
    block = block + (np.diag(np.where(is_tiny, least - variances, 0.0)) if has_tiny else 0.0)
    asymmetry = np.abs(block - block.T).max() / np.abs(block).max()
    if asymmetry > _ASYMMETRY_REPAIRED:
        raise MessageError("covariance_asymmetric")
    if asymmetry > _ASYMMETRY_EXACT:
        repairs.append("covariance_symmetrized")
    symmetric = 0.5 * block + 0.5 * block.T
    values, vectors = np.linalg.eigh(symmetric)
    floor = _DEFICIT_REPAIRED * values[-1]
    if values[0] < -floor or values[-1] <= 0.0:
        raise MessageError("covariance_not_positive_definite")
    is_flat = values[0] < 1e-3 * floor
    if is_flat:
        symmetric = (vectors * np.maximum(values, floor)) @ vectors.T
    return symmetric, repairs + ["covariance_floored"] * bool(is_flat or has_tiny)


@cache
def _bounds(size: int, lengths: int) -> tuple[Array, Array]:
    of_length = np.arange(size) < lengths
    return np.where(of_length, _MOST_M2, _MOST_RAD2), np.where(of_length, LEAST_M2, LEAST_RAD2)


def direction(azimuth: float, elevation: float = 0.0) -> tuple[tuple[float, float], bool]:
    """Angles within half a turn, and whether they had to be wrapped."""
    if max(abs(azimuth), abs(elevation)) > _MOST_TURNED_RAD:
        raise MessageError("bearing_out_of_range")
    wrapped = float(se2.wrap(azimuth)), float(se2.wrap(elevation))
    if abs(wrapped[1]) > 0.5 * math.pi:
        raise MessageError("bearing_out_of_range")
    is_wrapped = max(abs(azimuth), abs(elevation)) > math.pi
    return (wrapped if is_wrapped else (azimuth, elevation)), is_wrapped
