"""Which landmark is it: one message against landmarks, and landmarks against older ones."""

from itertools import product

import numpy as np
import pytest

from graph_slam_ros.slam.frontend.motion_compensation import KeyframeMeasurement
from graph_slam_ros.slam.landmarks import association
from graph_slam_ros.slam.landmarks.association import NEW, UNCLEAR, Candidates, Expected, Gates, likely_pairings

GATES = Gates(same=0.999, other=0.99999, density=0.03**2, margin=6.0, close_m=0.5)
SIGMA = 0.1


def seen(*points, sigma=SIGMA):
    return [KeyframeMeasurement(tuple(map(float, p)), sigma**2 * np.eye(2)) for p in points]


def landmarks(*points, sigma=SIGMA, shared=0.0, followed=None):
    """Each known to within sigma by itself, and all together shifted by the shared one."""
    count = len(points)
    covariance = sigma**2 * np.eye(2 * count) + shared**2 * np.kron(np.ones((count, count)), np.eye(2))
    is_followed = np.ones(count, dtype=bool) if followed is None else np.array(followed)
    return Expected(np.array(points, dtype=float), covariance, is_followed)


def found(sightings, what, *, jointly=True, gates=GATES):
    return [m.landmark for m in association.associate(gates, sightings, what, jointly=jointly)]


@pytest.mark.parametrize("jointly", [False, True])
def test_a_sighting_is_of_the_landmark_it_fits_and_of_a_new_one_where_it_fits_none(jointly):
    what = landmarks((0, 0), (5, 0))
    assert found(seen((5.1, 0.05), (0.0, 9.0), (-0.1, 0.0)), what, jointly=jointly) == [1, NEW, 0]


def test_without_landmarks_all_are_new():
    assert found(seen((0, 0), (1, 1)), landmarks_of_nothing()) == [NEW, NEW]


def landmarks_of_nothing():
    return Expected(np.empty((0, 2)), np.empty((0, 0)), np.empty(0, dtype=bool))


@pytest.mark.parametrize("jointly", [False, True])
def test_between_the_gates_a_sighting_is_of_nothing(jointly):
    chi2 = 0.5 * (GATES.chi2(2) + GATES.other_chi2(2))
    away = float(np.sqrt(chi2 * 2.0 * SIGMA**2))
    assert found(seen((away, 0.0)), landmarks((0, 0)), jointly=jointly) == [UNCLEAR]


@pytest.mark.parametrize("jointly", [False, True])
def test_a_landmark_is_seen_once_in_a_message_and_the_pairs_are_the_cheapest_together(jointly):
    """The first alone would be of landmark 0, which is the only one the second can be."""
    what = landmarks((0.0, 0.0), (0.45, 0.0))
    assert found(seen((0.2, 0.0), (-0.3, 0.0)), what, jointly=jointly) == [1, 0]


@pytest.mark.parametrize("jointly", [False, True])
def test_a_vague_landmark_is_not_taken_for_what_is_seen(jointly):
    """It is within the gate, but that says nothing where the gate holds several others."""
    away = (6.0, 0.0)
    assert found(seen(away), landmarks((0, 0), sigma=3.0), jointly=jointly) == [0]
    assert found(seen(away), landmarks((0, 0), sigma=30.0), jointly=jointly) != [0]


def test_rivals_close_to_each_other_widen_the_sighting_by_their_spread():
    (match,) = association.associate(GATES, seen((0.2, 0.0)), landmarks((0.0, 0.0), (0.4, 0.0)), jointly=True)
    assert match.landmark in (0, 1)
    assert match.spread == pytest.approx(np.diag([0.5 * 0.4**2, 0.0]))  # either, with even odds


def test_rivals_far_apart_leave_it_unclear():
    assert found(seen((0.5, 0.0), sigma=0.5), landmarks((0.0, 0.0), (1.0, 0.0))) == [UNCLEAR]


def test_a_rival_that_another_sighting_is_of_is_none():
    what = landmarks((0.0, 0.0), (1.0, 0.0), sigma=0.5)
    (a, b) = association.associate(GATES, seen((0.45, 0.0), (1.0, 0.0)), what, jointly=True)
    assert (a.landmark, b.landmark) == (0, 1)


def test_a_sighting_that_hardly_fits_is_not_pressed_on_a_landmark_where_one_seen_earlier_fits_better():
    points, followed = ((0.0, 0.0), (0.38, 0.0)), [True, False]
    assert found(seen((0.36, 0.0)), landmarks(points[0])) == [0]
    assert found(seen((0.36, 0.0)), landmarks(*points, followed=followed)) == [NEW]


def test_together_a_pair_is_refused_that_passes_alone():
    """The robot's place is vague, so each may be shifted by 2 m, but not one to the left and one to the right."""
    what = landmarks((0, 0), (0, 20), sigma=0.05, shared=1.0)
    apart = seen((1.5, 0.0), (-1.5, 20.0))
    assert found(apart, what, jointly=False) == [0, 1]
    together = found(apart, what, jointly=True)
    assert together != [0, 1] and (0 in together or 1 in together)
    assert found(seen((1.5, 0.0), (1.5, 20.0)), what, jointly=True) == [0, 1]


def candidates(residual, covariance, names):
    """Pairs of the named landmarks; two of one name exclude each other."""
    excluded = np.array([[a == b for b in names] for a in names])
    options = [[p for p, name in enumerate(names) if name == k] for k in range(max(names) + 1)]
    return Candidates(options, residual, covariance, excluded)


def drifted(offsets, names, drift=5.0):
    count = len(offsets)
    covariance = 0.04 * np.eye(2 * count) + drift**2 * np.kron(np.ones((count, count)), np.eye(2))
    return candidates(np.array(offsets, dtype=float).ravel(), covariance, names)


def test_landmarks_that_all_drifted_alike_are_older_ones_where_one_alone_is_not_clear():
    alone = likely_pairings(GATES, drifted([(4.0, 3.0), (-6.0, 1.0)], [0, 0]))
    assert {(0,), (1,)} <= set(alone)
    three = drifted([(4.0, 3.0), (-6.0, 1.0), (4.1, 2.9), (3.9, 3.1)], [0, 0, 1, 2])
    assert [sorted(pairs) for pairs in likely_pairings(GATES, three)] == [[0, 2, 3]]


def test_no_pair_is_likely_where_new_ones_cost_less():
    assert likely_pairings(GATES, drifted([(9.0, 9.0)], [0], drift=100.0))[0] == ()
    nothing = Candidates([], np.empty(0), np.empty((0, 0)), np.empty((0, 0), dtype=bool))
    assert likely_pairings(GATES, nothing) == [()]


def test_the_likely_pairings_are_those_of_trying_all():
    rng = np.random.default_rng(3)
    for _ in range(20):
        names = [0, 0, 1, 1, 2, 2]
        root = rng.normal(size=(12, 12)) + np.kron(np.ones((6, 6)), np.eye(2))
        c = candidates(rng.normal(size=12) * 2.0, root @ root.T + 0.1 * np.eye(12), names)
        every = {}
        for choice in product(*([None, *c.options[k]] for k in range(3))):
            pairs = tuple(p for p in choice if p is not None)
            statistic, cost = c.cost(pairs) if pairs else (0.0, 0.0)
            if not pairs or statistic < GATES.chi2(2 * len(pairs)):
                every[frozenset(pairs)] = cost - len(pairs) * GATES.new
        likely = {pairs for pairs, cost in every.items() if cost <= min(every.values()) + GATES.margin}
        told = likely_pairings(GATES, c)
        assert {frozenset(p) for p in told} == likely
        costs = [every[frozenset(p)] for p in told]
        assert costs == sorted(costs)
