"""iSAM2 with dynamic covariance scaling on all but odometry, relinearised at every step.

QR, since its default Cholesky factorisation throws on clean public graphs.
"""

import time

import gtsam
import numpy as np

from benchmarks.contenders import Believed
from benchmarks.contenders import gtsam_words as words
from benchmarks.problem import Edges, Problem
from graph_slam_ros.lie import se2, se3

_LOSSES = {"isam2": None, "isam2-dcs": gtsam.noiseModel.mEstimator.DCS.Create(1.0)}


def believe(problem: Problem, closures: Edges, name: str) -> Believed:
    """See ``contenders.believe``."""
    params = gtsam.ISAM2Params()
    params.setRelinearizeThreshold(0.1)
    params.relinearizeSkip = 1
    params.setFactorization("QR")
    isam, group = gtsam.ISAM2(params), se2 if problem.planar else se3
    given, candidates = words.prepared(problem), words.prepared_edges(closures)
    arrived = np.searchsorted(closures.ends.max(axis=1), np.arange(len(problem.poses) + 1))
    read = isam.calculateEstimatePose2 if problem.planar else isam.calculateEstimatePose3
    begin = time.process_time()
    for step, exact in zip(given.steps(), problem.steps(), strict=True):
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        if step.pose:
            motion = group.between(*(tuple(problem.poses[k].tolist()) for k in (step.pose - 1, step.pose)))
            pose = group.compose(tuple(words.numbers(read(step.pose - 1)).tolist()), motion)
        else:
            pose = tuple(problem.poses[0].tolist())
            words.add_anchor(graph, problem.poses[0])
        values.insert(step.pose, words.pose(np.array(pose)))
        for landmark, row in zip(step.landmarks, exact.first.tolist(), strict=True):
            point = se2.act(pose, tuple(exact.sightings.measured[row].tolist()))
            values.insert(words.landmark(landmark), np.array(point))
        words.add_relative(graph, step.relative)
        words.add_relative(graph, candidates[slice(*arrived[step.pose : step.pose + 2])], _LOSSES[name])
        words.add_sightings(graph, step.sightings, _LOSSES[name])
        try:
            isam.update(graph, values)
        except RuntimeError as error:
            reason = str(error).strip().splitlines()[0]
            return Believed(online_s=time.process_time() - begin, fault=f"throws at pose {step.pose}: {reason}")
    online_s = time.process_time() - begin
    poses, _ = words.estimate(isam.calculateEstimate(), len(problem.poses), 0, problem.planar)
    return Believed(online=poses, online_s=online_s)
