"""Decompression with a limit on the output, because the size that a file states may be wrong or malicious."""

import bz2
from io import BytesIO

import lz4.frame  # with zstandard a requirement of mcap
import zstandard

from graph_slam_ros.errors import FormatError

MOST_BYTES = 256 * 2**20
MOST_RATIO = 1000
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"


def decompressed(data: bytes, codec: str, size: int) -> bytes:
    """Decompress data of known size, compressed with ``zstd``, ``lz4``, ``bz2``, or not at all (``none``, empty).

    The size is checked before decompression, and the output is limited to it.

    Raises
    ------
    FormatError
        Another codec, a size over the limits, damaged data, or data of another size.
    """
    if size > MOST_BYTES:
        raise FormatError(f"it says to be {size} bytes; {MOST_BYTES} is the limit")
    if size > MOST_RATIO * len(data):
        raise FormatError(f"it says to be {size} bytes of {len(data)} compressed; {MOST_RATIO} to 1 is the limit")
    try:
        plain = _at_most(data, codec, size + 1)
    except MemoryError:
        raise FormatError(f"it says to be {size} bytes, and there is no memory for it") from None
    except (zstandard.ZstdError, RuntimeError, OSError, EOFError, ValueError) as error:  # lz4, then bz2
        raise FormatError(f"{codec}: {' '.join(str(error).split())}") from None
    if len(plain) != size:
        raise FormatError(f"it says to be {size} bytes and is {'more' if len(plain) > size else len(plain)}")
    return plain


def zstd_message(data: bytes) -> bytes:
    """Decompress a message that rosbag2 compressed by itself. Raises FormatError."""
    size = zstandard.frame_content_size(data)
    if size < 0:
        raise FormatError("zstd: it does not say its size")
    return decompressed(data, "zstd", size)


def _at_most(data: bytes, codec: str, most: int) -> bytes:
    if codec in ("", "none"):
        return data
    if codec == "zstd":  # decompress() would believe the size in the data
        with zstandard.ZstdDecompressor(max_window_size=MOST_BYTES).stream_reader(BytesIO(data)) as stream:
            return stream.read(most)
    if codec == "lz4":
        plain: bytes = lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=most)
        return plain
    if codec == "bz2":
        return bz2.BZ2Decompressor().decompress(data, max_length=most)
    raise FormatError(f"it is compressed as {codec!r}: only zstd, lz4 and bz2 are read")
