"""False loop closures: as many as wanted, as the policy says, and none that is true after all."""

import numpy as np
import pytest
from scipy.stats import chi2

from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.lie import se2, se3
from graph_slam_ros.tools.simulation import city_graph, simulate
from graph_slam_ros.tools.simulation.false_closures import POLICIES, count_for, disagreement, false_closures

ROOTS = {3: np.diag([20.0, 20.0, 100.0]), 7: np.diag([20.0, 20.0, 20.0, 100.0, 100.0, 100.0])}


def drawn(truth, count, policy, seed=1, **options):
    roots = np.array([ROOTS[truth.shape[1]], 0.5 * ROOTS[truth.shape[1]]])
    return false_closures(truth, roots, count, policy, np.random.default_rng(seed), **options)


@pytest.fixture(scope="module")
def paths():
    """Of a thousand poses each, in a small world: what is drawn anywhere is true now and then."""
    _, plane = city_graph(seed=3, poses=1000, blocks=3)
    flown = simulate("flight", 3, laps=3).T_world_base
    return {3: plane, 7: flown[:: len(flown) // 1000]}


SIZES = pytest.mark.parametrize("size", [3, 7], ids=["plane", "space"])


@SIZES
def test_a_policy_draws_as_many_as_are_wanted_and_the_same_ones_from_the_same_seed(paths, size):
    for rate in (0.0, 0.1, 0.5, 0.9):
        assert count_for(rate, 2099) / (count_for(rate, 2099) + 2099) == pytest.approx(rate, abs=1e-3)
    for policy in POLICIES:
        one, same, other = (drawn(paths[size], 57, policy, seed) for seed in (1, 1, 2))
        assert len(one) == len(one.measured) == len(one.root) == 57
        assert np.array_equal(one.ends, same.ends) and np.array_equal(one.measured, same.measured)
        assert not np.array_equal(one.measured, other.measured)
        assert (one.ends[:, 1] - one.ends[:, 0]).min() >= 2, "odometry joins neighbours"
        assert 0 <= one.ends.min() <= one.ends.max() < len(paths[size])


@SIZES
def test_what_agrees_with_the_truth_is_no_false_closure(paths, size):
    limit = 4.0 * chi2.ppf(0.9999, 3 if size == 3 else 6)
    for policy in ("random", "local", "group", "aliased"):
        vague = ROOTS[size] / (4.0 if policy == "local" else 10.0)

        def off(margin, policy=policy, vague=vague):
            rng = np.random.default_rng(1)
            found = false_closures(paths[size], vague[None], 300, policy, rng, margin=margin)
            return disagreement(paths[size], found.ends, found.measured, vague)

        assert off(4.0).min() > limit
        assert (off(0.0) < limit).any(), "or the test shows nothing"


@SIZES
def test_a_draw_is_off_the_identity_by_a_third_of_a_metre_and_ten_degrees(paths, size):
    found = drawn(paths[size], 2000, "random")
    group, n = (se2, 2) if size == 3 else (se3, 3)
    tangent = np.stack(group.log(tuple(found.measured.T)), axis=1)
    sigmas = [0.3] * n + [np.deg2rad(10.0)] * (tangent.shape[1] - n)
    assert tangent.std(axis=0) == pytest.approx(sigmas, rel=0.07)
    assert tangent.mean(axis=0) / sigmas == pytest.approx(np.zeros(len(sigmas)), abs=0.11)


def test_local_ones_join_poses_at_most_twenty_apart_and_a_group_is_consecutive_pairs_with_one_measurement(paths):
    for policy in ("local", "local-group"):
        apart = np.diff(drawn(paths[3], 600, policy).ends, axis=1)
        assert 2 <= apart.min() <= 4 and apart.max() == 20
    assert np.diff(drawn(paths[3], 600, "random").ends).max() > 500
    for policy in ("group", "local-group"):
        found = drawn(paths[3], 200, policy)
        ends, measured = found.ends.reshape(20, 10, 2), found.measured.reshape(20, 10, 3)
        assert (np.diff(ends, axis=1) == 1).all()
        assert (np.diff(measured, axis=1) == 0.0).all()
        assert len(np.unique(measured[:, 0], axis=0)) == 20
        assert (np.diff(drawn(paths[3], 40, policy, group=4).ends.reshape(10, 4, 2), axis=1) == 1).all()


@SIZES
def test_an_aliased_group_is_what_one_wrong_motion_of_its_second_stretch_would_be_seen_as(paths, size):
    truth, (group, dof) = paths[size], (se2, 3) if size == 3 else (se3, 6)
    found = drawn(truth, 100, "aliased", group=20)
    for k in range(0, 100, 20):
        ends, measured, root = found.ends[k : k + 20], found.measured[k : k + 20], found.root[k]
        assert ends[-1, 0] < ends[0, 1], "the stretches do not overlap"
        i, j = (tuple(truth[side].T) for side in ends.T)
        wrong = np.stack(group.compose(group.compose(i, tuple(measured.T)), group.inverse(j)), axis=1)
        moved = np.concatenate([truth[ends[:, 0]], np.stack(group.compose(tuple(wrong[10]), j), axis=1)])
        pairs = np.arange(20)[:, None] + [0, 20]
        # of two noises, the pair's own and that of the one that told the motion, which turns about a point far away
        assert np.median(disagreement(moved, pairs, measured, root)) < 20.0 * dof
        assert np.abs(np.stack(group.local(tuple(wrong[10]), (0.0,) * size if size == 3 else se3.IDENTITY))).max() > 0.5
        middle = np.stack(group.log(tuple(measured[10])))
        assert np.abs(middle[: 2 if size == 3 else 3]).max() < 1.5, "seen near by"


def test_a_false_closure_is_as_sure_of_itself_as_a_true_one(paths):
    found = drawn(paths[3], 300, "random")
    sure = found.root[:, 0, 0]
    assert set(sure) == {20.0, 10.0}
    assert 0.4 < (sure == 20.0).mean() < 0.6
    groups = drawn(paths[3], 300, "group").root[:, 0, 0].reshape(30, 10)
    assert (groups == groups[:, :1]).all()


def test_false_closures_that_cannot_be_drawn_are_refused():
    for poses, policy, told in (
        (np.zeros((50, 3)), "random", "draws agree with the truth"),
        (np.zeros((9, 3)), "group", "9 poses are too few for groups of 10"),
        (np.zeros((50, 3)), "often", "'often' is not one of random, local, group, local-group, aliased"),
    ):
        with pytest.raises(GraphSlamError, match=told):
            false_closures(poses, 1e-3 * np.eye(3)[None], 5, policy, np.random.default_rng(1))
