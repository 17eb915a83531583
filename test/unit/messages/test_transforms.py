"""Transforms: fixed and moving links, at a stamp, kept for a while."""

import pytest

from graph_slam_ros.lie import so3
from graph_slam_ros.messages.inputs.transforms import Transforms


def at(x=0.0, y=0.0, z=0.0, yaw=0.0):
    return (x, y, z, *so3.exp((0.0, 0.0, yaw)))


def test_messages_out_of_order_and_repeated_stamps_are_sorted_in_and_what_is_too_old_is_forgotten():
    t = Transforms(keep_ns=100)
    for stamp_ns, x in ((300, 3.0), (210, 1.0), (250, 7.0), (250, 2.0)):
        t.add_at(stamp_ns, "base", "arm", at(x))
    assert [t.lookup("base", "arm", s)[0] for s in (210, 230, 250, 275)] == pytest.approx([1.0, 1.5, 2.0, 2.5])
    for stamp_ns in range(310, 1000, 10):
        t.add_at(stamp_ns, "base", "arm", at(float(stamp_ns)))
    assert t.lookup("base", "arm", 885) is None
    assert t.lookup("base", "arm", 895)[0] == pytest.approx(895.0)
