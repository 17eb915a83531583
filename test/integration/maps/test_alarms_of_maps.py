"""The alarms of a map, such as that a robot was carried, stay with it, whatever is made of it."""

from dataclasses import asdict

import pytest
import small_drive

from graph_slam_ros.maps.edit import edit_run
from graph_slam_ros.maps.merge import merge
from graph_slam_ros.runs.folder import summary_of
from graph_slam_ros.runs.replay import replay
from graph_slam_ros.runs.restore import complete, freeze, map_of, record_run, recover
from graph_slam_ros.slam.doubt.record import Doubt

ALARM = Doubt(1_010_000_000_000, 30, 1_012_000_000_000, segment=7, distance_m=3.0)
TOLD = asdict(ALARM) | {"text": str(ALARM)}
EDIT = {"name": "a", "who": "b", "when": "2026-05-04T10:30:00Z", "why": "c", "do": "rename_landmark", "landmark": "1"}


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run whose map has an alarm."""
    folder = tmp_path_factory.mktemp("alarms")
    state = map_of(small_drive.run(folder / "before"), [])
    state.displacements = [TOLD]
    record_run(folder / "run", small_drive.config(), small_drive.drive(start_s=5000), [], state)
    return folder / "run"


def test_a_run_that_begins_in_a_map_has_the_alarms_of_the_map_and_so_have_its_copies(run, tmp_path):
    assert summary_of(run)["displacements"] == [TOLD]
    assert map_of(run, []).displacements == [TOLD]
    assert replay(run, tmp_path / "again").summary["displacements"] == [TOLD]
    assert recover(run, tmp_path / "recovered")["displacements"] == [TOLD]
    assert complete(tmp_path / "recovered")["displacements"] == [TOLD]
    assert freeze(run, tmp_path / "frozen")["displacements"] == [TOLD]
    edited = tmp_path / "edited"
    assert edit_run(run, [EDIT | {"to": "other"}], edited).summary["displacements"] == [TOLD]
    assert map_of(edited, []).displacements == [TOLD]


def test_a_merged_map_has_the_alarms_of_both_with_their_keyframes(run, tmp_path):
    other = small_drive.run(tmp_path / "other", start_s=9000)
    first = len(map_of(other, []).keyframes)
    (told,) = merge(other, run, tmp_path / "merged").summary["displacements"]
    assert told["segment"] == first + 7
    assert f"a segment begins at keyframe {first + 7}" in told["text"]
    assert merge(run, other, tmp_path / "merged the other way").summary["displacements"] == [TOLD]
