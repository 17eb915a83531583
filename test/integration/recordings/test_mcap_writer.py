"""Our writer of mcap writes what the library's writes, byte for byte."""

import io
import random

import pytest
from mcap.writer import CompressionType, Writer

from graph_slam_ros.recordings.mcap_records import LIBRARY
from graph_slam_ros.recordings.mcap_writer import McapWriter


def written(writer, seed, count, flush):
    """Write messages of three topics, with stamps out of order; flush now and then."""
    rng, channels = random.Random(seed), []
    for k in range(count):
        if k in (0, 5, 40):
            schema = writer.register_schema(f"some/msg/Type{k}", "ros2msg", b"float64 x" * k)
            channels.append(writer.register_channel(f"/topic{k}", "cdr", schema, {"offered_qos_profiles": "é"}))
        stamp_ns = rng.randrange(10**18)
        writer.add_message(rng.choice(channels), stamp_ns, rng.randbytes(rng.randrange(300)), stamp_ns + k, k)
        if rng.random() < 0.01:
            flush()
    writer.finish()


@pytest.mark.parametrize("chunk_bytes", [None, 1, 5_000, 2**20])
@pytest.mark.parametrize("count", [0, 1, 1000])
def test_our_writer_of_mcap_writes_the_bytes_of_the_library(chunk_bytes, count):
    ours, theirs = io.BytesIO(), io.BytesIO()
    library = Writer(theirs, chunk_size=2**40 if chunk_bytes is None else chunk_bytes, compression=CompressionType.ZSTD)
    library.start("ros2", LIBRARY)
    written(library, 3, count, library.flush)
    own = McapWriter(ours, "ros2", chunk_bytes)
    written(own, 3, count, own.end_chunk)
    assert ours.getvalue() == theirs.getvalue()
