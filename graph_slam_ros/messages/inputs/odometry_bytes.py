"""nav_msgs/Odometry by the places of its bytes, which is several times as fast as to decode it.

The two names of frames decide where the numbers are. A driver repeats them, so they are compared as bytes with those of
the message before.
"""

import struct
from dataclasses import dataclass

from graph_slam_ros.formats.cdr import CdrReader

_LITTLE_ENDIAN = b"\x00\x01"
_STAMP = struct.Struct("<iI")
_NUMBERS = struct.Struct("<7d288x6d")  # the pose, without its covariance, and the twist
_NAMES_AT = 12  # after the encapsulation and the stamp
_COVARIANCE_BYTES = 36 * 8
_MOST_PADDING = 3


@dataclass(slots=True)
class OdometryBytes:
    """The fields of a message that are used.

    Attributes
    ----------
    numbers : position, quaternion (x, y, z, w), linear and angular velocity
    twist_covariance : (6, 6), its bytes
    """

    sec: int
    nanosec: int
    frame_id: str
    child_frame_id: str
    numbers: tuple[float, ...]
    twist_covariance: bytes


class OdometryReader:
    """Reads messages of one topic."""

    def __init__(self) -> None:
        self._names, self._length, self._at, self._end = b"", -1, 0, 0
        self._frame_id = self._child_frame_id = ""

    def read(self, cdr: bytes) -> OdometryBytes | None:
        """Read a message. None if the decoder has to read it: what it says of its length is not what it is."""
        is_alike = len(cdr) == self._length and cdr[_NAMES_AT : self._at] == self._names and cdr[:2] == _LITTLE_ENDIAN
        if not is_alike and not self._learn(cdr):
            return None
        sec, nanosec = _STAMP.unpack_from(cdr, 4)
        numbers = _NUMBERS.unpack_from(cdr, self._at)
        return OdometryBytes(
            sec, nanosec, self._frame_id, self._child_frame_id, numbers, cdr[self._end - _COVARIANCE_BYTES : self._end]
        )

    def _learn(self, cdr: bytes) -> bool:
        """Find the names and the places of the numbers."""
        self._length = -1
        if cdr[:2] != _LITTLE_ENDIAN:
            return False
        reader = CdrReader(cdr)
        try:
            reader.stamp_ns()
            names = [reader.terminated(), reader.terminated()]
            self._frame_id, self._child_frame_id = (name.decode() for name in names)
        except (struct.error, ValueError):
            return False
        self._at = 4 + reader.aligned(8)
        self._end = self._at + _NUMBERS.size + _COVARIANCE_BYTES
        if not self._end <= len(cdr) <= self._end + _MOST_PADDING:
            return False
        self._names, self._length = cdr[_NAMES_AT : self._at], len(cdr)
        return True
