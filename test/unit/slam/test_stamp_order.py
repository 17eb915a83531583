"""Measurements are used exactly in order of stamp, whatever order within the window they came in."""

import itertools

from hypothesis import given, settings
from hypothesis import strategies as st

from graph_slam_ros.slam import Config, Counters, Odometry, Sighting, Sightings
from graph_slam_ros.slam.frontend.corrections import Corrections
from graph_slam_ros.slam.frontend.stamp_order import StampOrder

MS = 1_000_000
T0 = 1_700_000_000_000 * MS


def odometry(ms, x=0.0):
    return Odometry(T0 + ms * MS, (x, 0.0, 0.0))


def seen(ms, topic="/landmarks", name="a"):
    return Sightings(T0 + ms * MS, topic, (Sighting(name, "position", (1.0, 0.0), (1.0, 0.0, 0.0, 1.0)),))


def order(window_s=0.05, max_waiting=1000):
    config = Config.from_mapping({"ordering": {"window_s": window_s, "max_waiting": max_waiting}})
    return StampOrder(config.ordering, Counters())


def with_clock(offset_s):
    """A queue by a configured clock."""
    config = Config.from_mapping({"detections.offset_s": offset_s})
    return StampOrder(config.ordering, Counters(), Corrections(config).lag_ns)


def through(queue, measurements):
    out = []
    for m in measurements:
        if queue.accepts(m):
            out += queue.push(m)
    return out + queue.flush()


def key(m):
    return (m.stamp_ns, isinstance(m, Sightings), getattr(m, "topic", ""))


@settings(derandomize=True, deadline=None)
@given(st.data())
def test_B1_any_order_within_the_window_comes_out_in_order_of_stamp(data):
    stamps = data.draw(st.lists(st.integers(0, 400), min_size=1, max_size=40, unique=True))
    kinds = data.draw(st.lists(st.sampled_from(["odometry", "/a", "/b"]), min_size=len(stamps), max_size=len(stamps)))
    delays = data.draw(st.lists(st.integers(0, 24), min_size=len(stamps), max_size=len(stamps)))
    made = [odometry(t) if kind == "odometry" else seen(t, kind) for t, kind in zip(stamps, kinds, strict=True)]
    arrival = [
        m for _, _, m in sorted(zip((t + d for t, d in zip(stamps, delays, strict=True)), stamps, made, strict=True))
    ]
    queue = order(window_s=0.025)
    assert through(queue, arrival) == sorted(made, key=key)
    assert queue._counters.as_dict() == {}


def test_at_one_stamp_odometry_goes_first_then_topics_by_name_then_by_arrival():
    first, second = seen(5, "/b", "x"), seen(5, "/b", "y")
    for arrival in itertools.permutations([first, seen(5, "/a"), odometry(5)]):
        assert through(order(), [*arrival, second]) == [odometry(5), seen(5, "/a"), first, second]


def test_B16_landmarks_wait_for_the_first_odometry():
    queue = order()
    assert queue.push(seen(10)) == []
    assert queue.push(odometry(100)) == [seen(10)]


def test_B2_odometry_older_than_what_was_released_is_late_and_counted():
    queue = order()
    through(queue, [odometry(0), odometry(100)])
    assert not queue.accepts(odometry(99))
    assert queue.accepts(odometry(100)), "a duplicate is for the pipeline to judge"
    assert queue._counters.as_dict() == {"odometry": {"late": 1}}


def test_B16_a_full_queue_refuses_landmarks_and_counts_their_sightings():
    queue = order(max_waiting=3)
    for m in (seen(k, "/tags") for k in range(5)):
        assert not queue.accepts(m) or queue.push(m) == []
    assert queue._counters.as_dict() == {"/tags": {"overflow": 2}}
    assert queue.accepts(odometry(100)), "odometry makes room"
    assert len(queue.push(odometry(100))) == 3


def test_B22_odometry_that_repeats_one_stamp_for_ever_fills_no_memory():
    queue = order(max_waiting=3)
    released = through(queue, [odometry(7, x) for x in range(10)])
    assert len(released) == 3
    assert queue._counters.as_dict() == {"odometry": {"overflow": 7}}


def test_odometry_waits_for_a_sensor_that_is_late():
    """A sighting is seen 100 ms before its message comes."""
    queue, out = with_clock(-0.1), []
    for ms in range(0, 1000, 20):
        out += queue.push(odometry(ms))
        out += queue.push(seen(ms + 5 - 100, "detections"))
    out += queue.flush()
    stamps = [m.stamp_ns for m in out]
    assert stamps == sorted(stamps)
    assert len(out) == 100
