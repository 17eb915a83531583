"""The rule by which a landmark is gone, by itself: none wrongly, all that are gone after a few passes."""

import numpy as np
import pytest

from graph_slam_ros.slam.landmarks.presence import GONE, Pass, Presence, views_of

VIEWS = [("camera", k) for k in range(12)]


def drive(presence, rng, chance, passes):
    """So many passes past a landmark that each sees with a probability, through some of its views."""
    for _ in range(passes):
        first, count = rng.integers(12), rng.integers(1, 5)
        views = {VIEWS[(first + k) % 12] for k in range(count)}
        known = views & presence.views.keys()
        if rng.random() < chance:
            presence.see(known, {view for view in views if rng.random() < 0.8} or views)
        elif known:
            presence.miss(known)
        yield presence.is_gone


def test_no_landmark_that_is_there_is_ever_gone():
    rng = np.random.default_rng(1)
    for _ in range(40):
        presence, chance = Presence(), rng.uniform(0.5, 0.95)
        assert not any(drive(presence, rng, chance, 2000))


@pytest.mark.parametrize(("chance", "at_most"), [(0.98, 12), (0.85, 20), (0.5, 50)])
def test_a_landmark_that_is_gone_is_so_after_a_few_passes(chance, at_most):
    rng = np.random.default_rng(2)
    for _ in range(40):
        presence = Presence()
        list(drive(presence, rng, chance, 200))
        presence.forget()
        gone = list(drive(presence, rng, 0.0, 200))
        assert 3 <= gone.index(True) < at_most


def test_the_views_of_one_pass_are_hidden_by_the_same_thing():
    few, many = Presence(), Presence()
    for _ in range(50):
        few.see({VIEWS[0]}, {VIEWS[0]})
        many.see(set(VIEWS), set(VIEWS))
    few.miss({VIEWS[0]})
    many.miss(set(VIEWS))
    assert few.score == many.score < 0.0


def test_from_where_it_is_hardly_seen_a_pass_tells_hardly_anything():
    presence = Presence()
    for _ in range(50):
        presence.see({VIEWS[0], VIEWS[1]}, {VIEWS[0]})
    presence.see({VIEWS[0]}, {VIEWS[1]})
    before = presence.score
    presence.miss({VIEWS[1]})
    assert before - 0.1 < presence.score < before + 0.1


def test_places_elsewhere_count_where_they_agree():
    there, scattered = Presence(), Presence()
    for k in range(4):
        there.show_elsewhere((5.0 + 0.1 * k, 0.0), (0.0, 0.0))
        scattered.show_elsewhere((5.0 * (-1) ** k, 5.0 * k), (0.0, 0.0))
    assert there.score < GONE
    assert scattered.score > GONE / 2


def test_a_pass_ends_where_the_robot_has_driven_on():
    one = Pass(0.0, 0.0, 5.0, {})
    one.note(6.0, 4.0)
    assert not one.has_ended(10.9)
    assert one.has_ended(11.0)
    one.note(19.0, 4.0)
    assert one.has_ended(20.0)


def test_a_view_is_distance_line_of_sight_and_bearing():
    (ahead,), (metres,) = views_of(np.array([[4.0, 0.1]]), 0.0)
    assert metres == pytest.approx(4.0, abs=0.01)
    for delta, yaw in (([4.0, 0.1], 1.0), ([0.1, 4.0], np.pi / 2), ([8.0, 0.1], 0.0)):
        assert views_of(np.array([delta]), yaw)[0] != [ahead]
    assert views_of(np.array([[4.2, 0.2]]), 0.05)[0] == [ahead]


def test_a_record_has_all_of_it():
    presence, rng = Presence(), np.random.default_rng(3)
    list(drive(presence, rng, 0.7, 50))
    presence.show_elsewhere((1.0, 2.0), (0.0, 0.0))
    again = Presence()
    again.read(presence.record())
    assert again == presence
    assert Presence.is_record(presence.record())
    for wrong in ([], [0.0, 0, 0, [], False, [["camera", 1, 5, 3]]], [float("nan"), 0, 0, [], False, []]):
        assert not Presence.is_record(wrong)
