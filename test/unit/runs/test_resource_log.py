"""The record of what a run costs."""

import json

import numpy as np
import pytest

from graph_slam_ros.runs.resource_log import COLUMNS, ResourceLog, resident_mib


@pytest.mark.parametrize("count", [1, 2, 199, 200, 201, 12_345])
def test_samples_are_few_and_spread_over_the_whole_run(count):
    load = ResourceLog()
    for keyframe in range(1, count + 1):
        load.add(keyframe, 0)
    at = load.as_dict()["keyframes"]
    assert len(at) == count if count < 200 else 90 <= len(at) < 200
    assert count - at[-1] <= np.diff(at).max(initial=0)
    assert np.ptp(np.diff(at)) <= 1 if len(at) > 2 else True


def test_no_peak_of_the_backlog_is_lost():
    load = ResourceLog()
    for keyframe in range(1, 5001):
        load.add(keyframe, 70 if keyframe in (1, 777) else 0)
    assert load.as_dict()["backlog"].count(70) == 2


def test_its_columns_are_those_of_the_process():
    load = ResourceLog()
    assert load.as_dict() == {}
    before = resident_mib()
    load.add(3, 2)
    columns = json.loads(json.dumps(load.as_dict()))
    assert tuple(columns) == COLUMNS
    assert columns["keyframes"] == [3]
    assert columns["backlog"] == [2]
    assert columns["memory_mib"][0] == pytest.approx(before, abs=50.0)
    assert before > 10.0
