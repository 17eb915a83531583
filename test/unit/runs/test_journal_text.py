"""The JSON of the journal: odometry is written by hand, and as the encoder would write it."""

import json

import pytest

from graph_slam_ros.errors import FormatError
from graph_slam_ros.measurements.types import Odometry, from_record, to_record
from graph_slam_ros.recordings.mcap_records import Message, records
from graph_slam_ros.runs.journal import RecordWriter

TWIST = (0.1, 0.0, -0.0, 0.0, 1e-300, 0.0, 0.0, 0.0, 5e22)
SEVERAL = [
    Odometry(1, (0.0, -0.0, 1e-7)),
    Odometry(2, (0.1 + 0.2, 1e16, -123456789.125), TWIST, 'a "b"\n\u00e9'),
    Odometry(3, (1.5, 2.5, 3.5), TWIST),
    Odometry(4, (1.5, 2.5, 3.5), tuple(-x for x in TWIST)),
    Odometry(5, (5e-324, 1.7976931348623157e308, 1.0), tuple(x + 0.0 for x in TWIST)),
    Odometry(6, (1, 2, 3), (1, 0, 0, 0, 1, 0, 0, 0, 1)),
    Odometry(7, (1.0, 2.0, 3.0), (1.0, 0, 0, 0, 1, 0, 0, 0, 1)),
]


def written(file, several):
    writer = RecordWriter(file)
    writer.write(several)
    writer.close()
    return [one.data.decode() for one in records(file, []) if isinstance(one, Message)]


def test_odometry_is_written_as_the_encoder_writes_it_and_read_as_it_was(tmp_path):
    texts = written(tmp_path / "ingest.mcap", SEVERAL)
    assert texts == [json.dumps(to_record(m), separators=(",", ":")) for m in SEVERAL]
    assert [from_record(json.loads(text)) for text in texts] == SEVERAL


def test_what_is_not_finite_is_refused_before_it_is_written():
    with pytest.raises(FormatError, match="finite numbers"):
        Odometry(1, (0.0, float("nan"), 0.0))
