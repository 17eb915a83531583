"""What is written to a journal at once is one chunk, whatever is in it: a file that is cut has all of it or nothing."""

from mcap.records import ChunkIndex
from mcap.stream_reader import StreamReader

from graph_slam_ros.runs.journal import RecordWriter


def test_a_last_record_that_is_the_first_of_its_kind_is_in_the_chunk_of_the_others(tmp_path):
    writer = RecordWriter(tmp_path / "one.mcap")
    for kinds in (["a", "a", "b"], ["c"], ["a", "d"]):
        writer.write([{"type": kind, "stamp_ns": k} for k, kind in enumerate(kinds)])
    writer.close()
    with open(tmp_path / "one.mcap", "rb") as file:
        records = list(StreamReader(file, emit_chunks=False).records)
        chunks = [one for one in records if isinstance(one, ChunkIndex)]
    assert [sum(one.message_index_offsets.values()) > 0 for one in chunks] == [True] * 3
    assert [len(one.message_index_offsets) for one in chunks] == [2, 1, 2]
