"""Measurements are used exactly in order of stamp, whatever order within the window they came in."""

from hypothesis import given, settings
from hypothesis import strategies as st

from graph_slam_ros.slam import Config, Counters, Odometry, Sighting, Sightings
from graph_slam_ros.slam.frontend.stamp_order import StampOrder

MS = 1_000_000
T0 = 1_700_000_000_000 * MS


def odometry(ms, x=0.0):
    return Odometry(T0 + ms * MS, (x, 0.0, 0.0))


def seen(ms, topic):
    return Sightings(T0 + ms * MS, topic, (Sighting("a", "position", (1.0, 0.0), (1.0, 0.0, 0.0, 1.0)),))


def order(**settings):
    counters = Counters()
    return StampOrder(Config.from_mapping({"ordering": settings}).ordering, counters), counters


def through(queue, measurements):
    out = []
    for m in measurements:
        if queue.accepts(m):
            out += queue.push(m)
    return out + queue.flush()


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
    queue, counters = order(window_s=0.025)
    assert through(queue, arrival) == sorted(made, key=lambda m: m.stamp_ns)
    assert counters.as_dict() == {}


def test_B16_a_full_queue_refuses_landmarks_and_counts_their_sightings():
    queue, counters = order(max_waiting=3)
    for m in (seen(k, "/tags") for k in range(5)):
        assert not queue.accepts(m) or queue.push(m) == []
    assert counters.as_dict() == {"/tags": {"overflow": 2}}
    assert queue.accepts(odometry(100)), "odometry makes room"
    assert len(queue.push(odometry(100))) == 3


def test_B22_odometry_that_repeats_one_stamp_for_ever_fills_no_memory():
    queue, counters = order(max_waiting=3)
    assert len(through(queue, [odometry(7, x) for x in range(10)])) == 3
    assert counters.as_dict() == {"odometry": {"overflow": 7}}
