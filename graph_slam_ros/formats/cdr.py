"""Fast reading and writing of CDR bytes, for messages that are too slow as objects of a type store."""

import struct
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike

HEADER = b"\x00\x01\x00\x00"  # CDR, little endian
NS = 1_000_000_000
LATEST_NS = (2**31 - 1) * NS + 999_999_999  # that a builtin_interfaces/Time can say


def stamp(stamp_ns: int) -> bytes:
    """builtin_interfaces/Time; later stamps become the largest that it can represent."""
    return struct.pack("<iI", *divmod(min(stamp_ns, LATEST_NS), NS))


class CdrWriter:
    """Appends the fields of a message in order. Each number is aligned to its size."""

    __slots__ = ("_out",)

    def __init__(self) -> None:
        self._out = bytearray()

    def numbers(self, code: str, *values: float) -> None:
        """Numbers of one type, by its letter of ``struct``; of a sequence its length goes before."""
        self._align(struct.calcsize(code))
        self._out += struct.pack(f"<{len(values)}{code}", *values)

    def text(self, text: str) -> None:
        """A string."""
        encoded = text.encode() + b"\x00"
        self.numbers("I", len(encoded))
        self._out += encoded

    def array(self, values: ArrayLike, dtype: DTypeLike = "<f8") -> None:
        """All numbers of an array, the last index first, after the length if it is a sequence."""
        numbers = np.ascontiguousarray(values, dtype=dtype)
        if numbers.size:  # nothing is aligned for what is not there
            self._align(numbers.itemsize)
            self._out += numbers.tobytes()

    def header(self, stamp_ns: int, frame: str) -> None:
        """std_msgs/Header."""
        self._align(4)
        self._out += stamp(stamp_ns)
        self.text(frame)

    def message(self) -> bytes:
        """The message so far."""
        return HEADER + self._out

    def _align(self, size: int) -> None:
        self._out += bytes(-len(self._out) % size)


class CdrReader:
    """Reads the first fields of a message in order, of either byte order, without decoding the rest.

    Raises ``struct.error`` if the message ends before the field.
    """

    __slots__ = ("_at", "_data", "_order")

    def __init__(self, message: bytes) -> None:
        self._data, self._at = memoryview(message)[4:], 0
        self._order = "<" if len(message) > 1 and message[1] & 1 else ">"

    def numbers(self, code: str, count: int = 1) -> tuple[Any, ...]:
        """Numbers of one type, by its letter of ``struct``."""
        size = struct.calcsize(code)
        self._at += -self._at % size
        out = struct.unpack_from(f"{self._order}{count}{code}", self._data, self._at)
        self._at += count * size
        return out

    def stamp_ns(self) -> int:
        """builtin_interfaces/Time in nanoseconds."""
        return int(self.numbers("i")[0]) * NS + int(self.numbers("I")[0])

    def text(self) -> bytes:
        """A string, without its terminating zero."""
        (length,) = self.numbers("I")
        self._at += length
        return bytes(self._data[self._at - length : self._at]).rstrip(b"\0")

    def terminated(self) -> bytes:
        """A string, without its terminating zero. Raises ValueError where it has none, or another zero."""
        (length,) = self.numbers("I")
        self._at += length
        text = bytes(self._data[self._at - length : self._at])
        if len(text) != length or text.find(b"\0") != length - 1:
            raise ValueError("a string without its terminating zero")
        return text[:-1]

    def aligned(self, size: int) -> int:
        """Return where the next number of a size begins, in bytes after the encapsulation."""
        return self._at + -self._at % size
