"""GTSAM on the whole graph, with default settings: Gauss-Newton, Levenberg-Marquardt and graduated non-convexity.

Among false measurements all start from the odometry, which has no loss and is known to be right. The scales of losses
are those of GTSAM's own constructors and examples.
"""

import time

import gtsam
import numpy as np

from benchmarks.contenders import MAX_ITERATIONS, Believed, Solved, settled
from benchmarks.contenders import gtsam_words as words
from benchmarks.problem import Edges, Problem

_LOSSES = {
    "gtsam-huber": gtsam.noiseModel.mEstimator.Huber.Create(1.345),
    "gtsam-gm": gtsam.noiseModel.mEstimator.GemanMcClure.Create(1.0),
}
_INLIERS = 0.99  # GNC's threshold, as a quantile of chi2


def solve(problem: Problem, name: str) -> Solved:
    """All at once."""
    given = words.prepared(problem)
    begin = time.process_time()
    graph, values = words.graph_of(given)
    kind = gtsam.GaussNewtonOptimizer if name == "gtsam-gn" else gtsam.LevenbergMarquardtOptimizer
    try:
        optimizer = kind(graph, values)
        fault = _iterated(optimizer)
    except RuntimeError as error:
        return Solved([time.process_time() - begin], fault=words.thrown(error))
    cpu_s = time.process_time() - begin
    answer = words.estimate(optimizer.values(), len(given.poses), len(given.landmarks), given.planar)
    return Solved([cpu_s], *answer, fault)


def believe(problem: Problem, closures: Edges, name: str) -> Believed:
    """See ``contenders.believe``."""
    given, candidates = words.prepared(problem), words.prepared_edges(closures)
    begin, out = time.process_time(), Believed()
    graph, values = words.graph_of(given, candidates, _LOSSES.get(name))
    try:
        if name == "gtsam-gnc":
            known = 1 + len(given.relative)  # the anchor, and odometry
            params = gtsam.GncLMParams()
            params.setKnownInliers(list(range(known)))
            optimizer = gtsam.GncLMOptimizer(graph, values, params)
            optimizer.setInlierCostThresholdsAtProbability(_INLIERS)
            values = optimizer.optimize()
            out.weights = np.asarray(optimizer.getWeights())[known:]
        else:
            optimizer = gtsam.LevenbergMarquardtOptimizer(graph, values)
            _iterated(optimizer)
            values = optimizer.values()
    except RuntimeError as error:
        out.fault = words.thrown(error)
    out.batch_s = time.process_time() - begin
    if not out.fault:
        out.batch, _ = words.estimate(values, len(given.poses), 0, given.planar)
    return out


def _iterated(optimizer: gtsam.NonlinearOptimizer) -> str:
    """Iterate by the common rule; returns what is wrong with the end."""
    start = before = optimizer.error()
    for _ in range(MAX_ITERATIONS):
        optimizer.iterate()
        error = optimizer.error()
        if not np.isfinite(error) or settled(before, error):
            return "" if error < start else "diverged"
        before = error
    return "not converged" if error < start else "diverged"
