"""The dense kernels of the fronts against NumPy, at sizes on both sides of every path through them."""

import numpy as np
from rows import each
from scipy.linalg import solve_triangular

from graph_slam_ros.solver.clique_tree.numeric import WIDE, pack, partial_cholesky, solve_upper
from graph_slam_ros.solver.clique_tree.storage import NOTHING, packed_size

SIZES = [(1, 1), (3, 3), (6, 2), (7, 7), (12, 5), (26, 2), (26, 3), (27, 3), (40, 33), (90, 47)]
SIZES += [(3 * WIDE - 1, WIDE), (3 * WIDE, WIDE - 1), (3 * WIDE, WIDE), (3 * WIDE + 1, WIDE + 3)]
SIZES += [(4 * WIDE + 5, 2 * WIDE + 1), (5 * WIDE, 5 * WIDE), (401, 230), (500, 20)]


def random_front(n, right, seed):
    """A positive definite matrix, some right sides, and both as a front: nothing below the diagonal."""
    rng = np.random.default_rng(seed)
    root = rng.standard_normal((n, n + 5)) * np.exp(rng.uniform(-2.0, 2.0, (n, 1)))
    a, b = root @ root.T, rng.standard_normal((n, right))
    return a, b, np.hstack([np.triu(a), b])


def off(found, expected):
    return np.abs(found - expected).max(initial=0.0) / np.abs(expected).max(initial=1e-300)


@each("right", [1, 3])
@each("n, frontal", SIZES)
def test_elimination_leaves_the_factor_and_the_schur_complement_and_solves_the_system(n, frontal, right):
    a, b, front = random_front(n, right, 7 * n + frontal)
    assert partial_cholesky(front, frontal, np.diag(a).copy()) == NOTHING
    u = np.linalg.cholesky(a[:frontal, :frontal]).T
    below = solve_triangular(u, np.hstack([a[:frontal, frontal:], b[:frontal]]), trans="T")
    rounding = 1e-13 * np.linalg.cond(a[:frontal, :frontal])
    bound = max(1e-12, rounding)
    assert off(np.triu(front[:frontal, :frontal], 1), np.triu(u, 1)) <= bound
    assert off(1.0 / np.diag(front)[:frontal], np.diag(u)) <= bound
    assert off(front[:frontal, frontal:], below) <= bound
    rest = np.hstack([a[frontal:, frontal:], b[frontal:]]) - below[:, : n - frontal].T @ below
    upper = np.triu_indices(n - frontal, 0, n - frontal + right)
    scale = np.abs(a).max() + np.abs(b).max()
    assert np.abs(front[frontal:, frontal:][upper] - rest[upper]).max(initial=0.0) <= bound * scale

    if right > 1:
        return
    x = np.full(n, np.nan)  # and back-substitution solves the system
    x[frontal:] = np.random.default_rng(n).standard_normal(n - frontal)
    given = x[frontal:].copy()
    packed = np.empty(packed_size(n))
    pack(front, packed)
    solve_upper(packed, n, frontal, x)
    assert np.array_equal(x[frontal:], given)
    # U11 x_F + U12 x_S = y is A_FF x_F + A_FS x_S = b_F
    expected = np.linalg.solve(a[:frontal, :frontal], b[:frontal, 0] - a[:frontal, frontal:] @ given)
    assert off(x[:frontal], expected) <= max(1e-12, rounding)


@each("n, frontal", [(n, f) for n, f in SIZES if f > 1])
@each("where", [0.3, 0.999])
def test_a_pivot_that_is_lost_is_found_where_it_is(n, frontal, where):
    lost = max(1, int(where * frontal))
    rng = np.random.default_rng(n)
    root = rng.standard_normal((n, n + 5))
    root[lost] = rng.standard_normal(lost) @ root[:lost]  # it says nothing that earlier rows do not
    a = root @ root.T
    front = np.hstack([np.triu(a), np.zeros((n, 1))])
    # rounding may leave a little more than the bound of what is exactly nothing, the more the larger the front
    scale = np.diag(a).copy() * max(1.0, n)
    assert partial_cholesky(front, frontal, scale) == lost


@each("bad", [0.0, -1.0, np.nan])
def test_a_pivot_that_is_no_positive_number_is_refused(bad):
    assert partial_cholesky(np.hstack([np.diag([1.0, bad, 1.0]), np.zeros((3, 1))]), 3, np.ones(3)) == 1
    assert partial_cholesky(np.zeros((3, 4)), 3, np.zeros(3)) == 0, "nothing is known of it"
