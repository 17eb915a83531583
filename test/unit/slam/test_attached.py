"""Keyframes that left the map, in a temporary file: found by stamp, and readable after a write that failed."""

import resource

import numpy as np
import pytest

from graph_slam_ros.graph.geometry import PLANAR
from graph_slam_ros.slam.frontend.attached import AttachedKeyframes, attached_type
from graph_slam_ros.slam.lifelong.removed import record_type


def rows(first, count):
    keyframes = np.zeros(count, record_type(PLANAR))
    keyframes["stamp_ns"] = 10 * np.arange(first, first + count)
    attached = np.zeros(count, attached_type(PLANAR))
    attached["base"] = np.arange(first, first + count)
    return keyframes, attached


def test_each_is_found_by_a_stamp_at_or_after_it():
    one = AttachedKeyframes()
    one.add(PLANAR, 5, *rows(5, 3))
    one.add(PLANAR, 8, *rows(8, 2))
    assert (one.first, one.end) == (5, 10)
    assert [one.before(stamp, 0) for stamp in (49, 50, 59, 60, 95, 1000)] == [None, 5, 5, 6, 9, 9]
    assert one.before(55, 6) is None
    assert [int(one.read(k)["base"]) for k in range(5, 10)] == [5, 6, 7, 8, 9]
    with pytest.raises(IndexError, match="keyframe 10 is not among 5 to 9"):
        one.read(10)


def test_on_a_full_disk_those_before_are_still_read_and_the_next_go_on():
    one = AttachedKeyframes()
    one.add(PLANAR, 0, *rows(0, 4))
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, before[1]))
    try:
        with pytest.raises(OSError):
            one.add(PLANAR, 4, *rows(4, 50))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert one.end == 4
    assert one.before(1000, 0) == 3
    one.add(PLANAR, 4, *rows(4, 50))
    assert int(one.read(53)["base"]) == 53
