"""Checks of every message, whatever its type."""

import math
from functools import cache
from typing import Any

import numpy as np

from graph_slam_ros.lie import se2
from graph_slam_ros.measurements.edge_noise import LEAST_M2, LEAST_RAD2
from graph_slam_ros.typing import Array, Mask

_NORM_REPAIRED = 0.1  # a quaternion this far from unit length is normalised, beyond it is refused
_NORM_EXACT, _SQUARE_EXACT = 1e-6, 1.9e-6
_ASYMMETRY_REPAIRED, _ASYMMETRY_EXACT = 1e-2, 1e-6
_DEFICIT_REPAIRED = 1e-9  # negative eigenvalues down to this fraction of the largest are rounding
_FARTHEST_M = 1e9
_MOST_M2, _MOST_RAD2 = 1e6, 1e3  # as good as unknown; drivers send up to 1.8e308
_MOST_TURNED_RAD = 4.0 * math.pi  # a bearing that is farther from zero is no count of turns


class MessageError(Exception):
    """A message, or one item of it, that is refused; its text is the reason it is counted under."""


def stamp_ns(stamp: Any) -> int:
    """Nanoseconds of a builtin_interfaces/Time."""
    if stamp.sec < 0 or not 0 <= stamp.nanosec < 1_000_000_000:
        raise MessageError("bad_stamp")
    out = stamp.sec * 1_000_000_000 + stamp.nanosec
    if out == 0:
        raise MessageError("zero_stamp")
    return int(out)


def are_sound(x: Array, y: Array, z: Array) -> Mask:
    """Return whether ``point`` accepts coordinates."""
    return (abs(x) <= _FARTHEST_M) & (abs(y) <= _FARTHEST_M) & (abs(z) <= _FARTHEST_M)


def are_units(x: Array, y: Array, z: Array, w: Array) -> Mask:
    """Return whether ``quaternion`` surely returns the numbers as they are."""
    return abs(x * x + y * y + z * z + w * w - 1.0) <= _SQUARE_EXACT


def point(v: Any) -> tuple[float, float, float]:
    """Finite coordinates of a Point or Vector3 of plausible size."""
    if not (math.isfinite(v.x) and math.isfinite(v.y) and math.isfinite(v.z)):
        raise MessageError("nonfinite")
    if max(abs(v.x), abs(v.y), abs(v.z)) > _FARTHEST_M:
        raise MessageError("too_far")
    return float(v.x), float(v.y), float(v.z)


def quaternion(q: Any) -> tuple[tuple[float, float, float, float], bool]:
    """Unit quaternion (x, y, z, w), and whether it had to be normalised."""
    norm = math.sqrt(q.x * q.x + q.y * q.y + q.z * q.z + q.w * q.w)
    if abs(norm - 1.0) <= _NORM_EXACT:
        return (q.x, q.y, q.z, q.w), False
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
