"""GTSAM's Gauss-Newton and Levenberg-Marquardt with their default settings, iterated by the common rule."""

import time

import gtsam
import numpy as np

from benchmarks.contenders import MAX_ITERATIONS, Solved, settled
from benchmarks.contenders import gtsam_words as words
from benchmarks.problem import Problem

_OPTIMIZERS = {"gtsam-gn": gtsam.GaussNewtonOptimizer, "gtsam-lm": gtsam.LevenbergMarquardtOptimizer}


def solve(problem: Problem, name: str) -> Solved:
    """All at once."""
    given = words.prepared(problem)
    begin = time.process_time()
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for k, pose in enumerate(given.poses.tolist()):
        values.insert(k, words.pose(pose))
    for k, point in enumerate(given.landmarks):
        values.insert(words.landmark(k), point)
    words.add_anchor(graph, given.poses[0])
    words.add_relative(graph, given.relative)
    words.add_sightings(graph, given.sightings)
    built = time.process_time()
    fault = ""
    try:
        optimizer = _OPTIMIZERS[name](graph, values)
        start = before = optimizer.error()
        for _ in range(MAX_ITERATIONS):
            optimizer.iterate()
            error = optimizer.error()
            if not np.isfinite(error) or settled(before, error):
                break
            before = error
        else:
            fault = "not converged"
    except RuntimeError as error:
        return Solved(built - begin, time.process_time() - built, fault=f"throws: {str(error).strip().splitlines()[0]}")
    done = time.process_time()
    if not error < start:
        fault = "diverged"
    answer = words.estimate(optimizer.values(), len(given.poses), len(given.landmarks), given.planar)
    return Solved(built - begin, done - built, optimizer.iterations(), *answer, fault)
