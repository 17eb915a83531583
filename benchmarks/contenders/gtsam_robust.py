"""GTSAM's answers to false measurements in batch: robust losses under Levenberg-Marquardt, and graduated non-convexity.

All start from the odometry, which has no loss and is known to be right; default settings otherwise. The scales are
those of GTSAM's own constructors and examples.
"""

import time

import gtsam
import numpy as np

from benchmarks.contenders import MAX_ITERATIONS, Believed, settled
from benchmarks.contenders import gtsam_words as words
from benchmarks.problem import Edges, Problem

_LOSSES = {
    "gtsam-huber": gtsam.noiseModel.mEstimator.Huber.Create(1.345),
    "gtsam-gm": gtsam.noiseModel.mEstimator.GemanMcClure.Create(1.0),
    "gtsam-dcs": gtsam.noiseModel.mEstimator.DCS.Create(1.0),
}
_INLIERS = 0.99  # GNC's threshold, as a quantile of chi2


def believe(problem: Problem, closures: Edges, name: str) -> Believed:
    """See ``contenders.believe``."""
    given, candidates = words.prepared(problem), words.prepared_edges(closures)
    begin = time.process_time()
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for k, pose in enumerate(given.poses.tolist()):
        values.insert(k, words.pose(pose))
    for k, point in enumerate(given.landmarks):
        values.insert(words.landmark(k), point)
    words.add_anchor(graph, given.poses[0])
    words.add_relative(graph, given.relative)
    known = graph.size()
    words.add_relative(graph, candidates, _LOSSES.get(name))
    words.add_sightings(graph, given.sightings, _LOSSES.get(name))
    out = Believed()
    try:
        if name == "gtsam-gnc":
            params = gtsam.GncLMParams()
            params.setKnownInliers(list(range(known)))
            optimizer = gtsam.GncLMOptimizer(graph, values, params)
            optimizer.setInlierCostThresholdsAtProbability(_INLIERS)
            values = optimizer.optimize()
            out.weights = np.asarray(optimizer.getWeights())[known:]
        else:
            values = _minimised(gtsam.LevenbergMarquardtOptimizer(graph, values))
    except RuntimeError as error:
        out.fault = f"throws: {str(error).strip().splitlines()[0]}"
    out.batch_s = time.process_time() - begin
    if not out.fault:
        out.batch, _ = words.estimate(values, len(given.poses), 0, given.planar)
    return out


def _minimised(optimizer: gtsam.LevenbergMarquardtOptimizer) -> gtsam.Values:
    before = optimizer.error()
    for _ in range(MAX_ITERATIONS):
        optimizer.iterate()
        error = optimizer.error()
        if not np.isfinite(error) or settled(before, error):
            break
        before = error
    return optimizer.values()
