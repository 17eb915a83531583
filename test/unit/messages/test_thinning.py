"""What is shown of too much is bounded, and the same as more comes."""

import numpy as np
from rows import each

from graph_slam_ros.messages.path_thinning import thinned, worst_and_some


@each("count, most", [(0, 5), (1, 5), (2, 2), (5, 5), (6, 5), (9, 5), (10, 5), (12, 3), (999, 2), (999, 64)])
def test_a_path_is_thinned_to_the_bound_and_keeps_its_first_and_its_last(count, most):
    kept = thinned(count, most)
    assert len(kept) <= most
    assert (np.diff(kept) > 0).all()
    assert {0, count - 1} <= set(kept.tolist()) or count == 0
    half_the_stride = np.append(np.arange(0, count - 1, (kept[1] - kept[0]) / 2), count - 1) if count > 1 else []
    assert len(kept) == count if count <= most else len(half_the_stride) > most, "no more is left out than must be"
    assert (thinned(count, 0) == np.arange(count)).all()


@each("most", [1, 2, 7, 64, 999])
def test_of_many_edges_the_worst_are_shown_and_some_of_all(most):
    rng = np.random.default_rng(most)
    ids = np.flatnonzero(rng.uniform(size=2000) < 0.7)
    misfit = rng.exponential(size=len(ids))
    shown = worst_and_some(ids, misfit, most)
    assert len(shown) <= most
    assert (np.diff(shown) > 0).all()
    worst = ids[np.argsort(misfit)][len(ids) - most // 2 :]
    assert set(worst.tolist()) <= set(shown.tolist())
    others, rest = np.setdiff1d(shown, worst), np.setdiff1d(ids, worst)
    stride = next(2**k for k in range(12) if len(rest[rest % 2**k == 0]) <= most - most // 2)
    assert others.tolist() == rest[rest % stride == 0].tolist()
    few = ids[:most]
    assert worst_and_some(few, misfit[:most], most).tolist() == few.tolist()
    assert worst_and_some(ids[:0], np.empty(0), most).tolist() == []
