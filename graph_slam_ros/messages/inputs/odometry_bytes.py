"""nav_msgs/Odometry by the places of its bytes: several messages at once, which is faster than to decode each.

The two names of frames decide where the numbers are. A driver repeats them, so they are compared as bytes.
"""

import struct
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import takewhile

import numpy as np

from graph_slam_ros.formats.cdr import CdrReader
from graph_slam_ros.typing import Array, Index

_LITTLE_ENDIAN = b"\x00\x01"
_NAMES_AT = 12  # after the encapsulation and the stamp
_POSE_BYTES, _TWIST_BYTES, _COVARIANCE_BYTES = 7 * 8, 6 * 8, 36 * 8
_MOST_PADDING = 3


@dataclass(frozen=True, slots=True)
class OdometryRun:
    """The fields of n messages in order, which have the same frames and the same covariance of the twist.

    Attributes
    ----------
    sec, nanosec : (n,)
    numbers : (n, 13): position, quaternion (x, y, z, w), linear and angular velocity
    twist_covariance : (6, 6), its bytes
    """

    sec: Index
    nanosec: Index
    frame_id: str
    child_frame_id: str
    numbers: Array
    twist_covariance: bytes

    def first(self, count: int) -> "OdometryRun":
        """The first so many of them."""
        return replace(self, sec=self.sec[:count], nanosec=self.nanosec[:count], numbers=self.numbers[:count])


class OdometryReader:
    """Reads messages of one topic."""

    def __init__(self) -> None:
        self._names, self._length, self._at, self._end = b"", -1, 0, 0
        self._frame_id = self._child_frame_id = ""
        self._row = np.dtype([])

    def read_run(self, cdrs: Sequence[bytes]) -> OdometryRun | None:
        """Read messages from the first on, as far as they are like it. None if the decoder has to read the first."""
        if not self._is_alike(cdrs[0]) and not self._learn(cdrs[0]):
            return None
        covariance = self._covariance(cdrs[0])
        run = list(takewhile(lambda cdr: self._is_alike(cdr) and self._covariance(cdr) == covariance, cdrs))
        rows = np.frombuffer(b"".join(run), self._row)
        sec, nanosec = (rows[name].astype(np.int64) for name in ("sec", "nanosec"))
        numbers = np.concatenate((rows["pose"], rows["twist"]), axis=1)
        return OdometryRun(sec, nanosec, self._frame_id, self._child_frame_id, numbers, covariance)

    def _is_alike(self, cdr: bytes) -> bool:
        """Return whether a message has the length and the names that are known."""
        return len(cdr) == self._length and cdr[_NAMES_AT : self._at] == self._names and cdr[:2] == _LITTLE_ENDIAN

    def _covariance(self, cdr: bytes) -> bytes:
        return cdr[self._end - _COVARIANCE_BYTES : self._end]

    def _learn(self, cdr: bytes) -> bool:
        """Find the names and the places of the numbers; they are not where the length is not what it says."""
        self._length = -1
        reader = CdrReader(cdr)
        try:
            reader.stamp_ns()
            names = [reader.terminated(), reader.terminated()]
            self._frame_id, self._child_frame_id = (name.decode() for name in names)
        except (struct.error, ValueError):
            return False
        self._at = 4 + reader.aligned(8)
        twist_at = self._at + _POSE_BYTES + _COVARIANCE_BYTES
        self._end = twist_at + _TWIST_BYTES + _COVARIANCE_BYTES
        if cdr[:2] != _LITTLE_ENDIAN or not self._end <= len(cdr) <= self._end + _MOST_PADDING:
            return False
        self._names, self._length = cdr[_NAMES_AT : self._at], len(cdr)
        at = {"sec": ("<i4", 4), "nanosec": ("<u4", 8), "pose": ("<7f8", self._at), "twist": ("<6f8", twist_at)}
        formats, offsets = zip(*at.values(), strict=True)
        self._row = np.dtype({"names": list(at), "formats": formats, "offsets": offsets, "itemsize": len(cdr)})
        return True
