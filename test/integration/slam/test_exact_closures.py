"""Closures of a millimetre after rough odometry: far off when they come, and true."""

import math

import numpy as np

from graph_slam_ros.lie import se2
from graph_slam_ros.slam import Closure, Config, Control, GraphSlam, Odometry
from graph_slam_ros.slam.robust.ledger import Verdict

SECOND_NS = 10**9
EXACT = (1e-3, 1e-3, 1e-3)
CONFIG = {"odometry.still_m_s": 0.0, "odometry.still_rad_s": 0.0}


def covariance(sigmas):
    return tuple(np.diag(np.square(sigmas)).ravel().tolist())


def drive(around, false_every=0, seed=0, rough=(0.1, 0.1, 0.05)):
    """Two laps, each fifth keyframe with a true closure: pipeline, true ones, false ones (from across the circle)."""
    rng, step = np.random.default_rng(seed), (0.5, 0.0, 2.0 * math.pi / around)
    true = [se2.IDENTITY]
    for _ in range(2 * around):
        true.append(se2.compose(true[-1], step))
    slam, odometry, is_false = GraphSlam(Config.from_mapping(CONFIG)), se2.IDENTITY, []
    for k in range(len(true)):
        if k:
            odometry = se2.compose(odometry, tuple(np.array(step) + rng.normal(0.0, rough)))
        slam.process(Odometry(k * SECOND_NS, odometry, covariance(rough)))
        ends = [(k - 2, k)] if 2 <= k < 14 else [(k - around, k)] if k >= around and k % 5 == 0 else []
        if false_every and k > around and k % false_every == 0:
            ends.append((k - around // 2, None))
        for earlier, seen in ends:
            measured = se2.IDENTITY if seen is None else se2.between(true[earlier], true[seen])
            measured = tuple(np.array(measured) + rng.normal(0.0, EXACT))
            source = f"closures{len(is_false)}"
            slam.process(Closure(k * SECOND_NS, earlier * SECOND_NS, source, measured, covariance(EXACT)))
            is_false.append(seen is None)
    slam.process(Control("end"))
    edges = slam.view.graph.edges_of("closures")
    in_order = sorted(edges.tolist(), key=lambda edge: int(slam.view.graph.source_of(edge)[8:]))
    return slam, *([edge for edge, wrong in zip(in_order, is_false, strict=True) if wrong == w] for w in (False, True))


def test_no_exact_closure_is_lost_however_far_odometry_is_off():
    """Judged before the solve has converged, each is rejected at once, at a chi2 of millions."""
    slam, true, _ = drive(60)
    edges = [edge for edge in true if edge < len(slam.view.ledger)]
    assert all(slam.view.ledger.are_inside(edges))
    assert not [one for one in slam.view.ledger.history if one.verdict is Verdict.REJECTED]
    slam.process(Control("optimize"))
    assert all(slam.view.ledger.are_inside(true))
    assert slam.view.solver.evaluate().chi2_final < 5 * len(true)  # odometry is noisy, too


def test_false_closures_among_exact_ones_are_still_refused():
    """Full weight is for what is expected to fit."""
    slam, true, false = drive(60, false_every=8)
    slam.process(Control("optimize"))
    assert len(false) >= 6
    assert all(slam.view.ledger.are_inside(true))
    assert not any(slam.view.ledger.are_inside(false))
