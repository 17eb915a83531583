"""What waits for its turn by stamp is bounded."""

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


def test_B16_a_full_queue_refuses_landmarks_and_counts_their_sightings():
    queue, counters = order(max_waiting=3)
    for m in (seen(k, "/tags") for k in range(5)):
        assert not queue.accepts(m) or queue.push(m) == []
    assert counters.as_dict() == {"/tags": {"overflow": 2}}
    assert queue.accepts(odometry(100)), "odometry makes room"
    assert len(queue.push(odometry(100))) == 3


def test_B22_odometry_that_repeats_one_stamp_for_ever_fills_no_memory():
    queue, counters = order(max_waiting=3)
    assert not any(queue.push(m) for m in (odometry(7, x) for x in range(10)) if queue.accepts(m))
    assert len(queue.flush()) == 3
    assert counters.as_dict() == {"odometry": {"overflow": 7}}
