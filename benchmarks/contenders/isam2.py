"""GTSAM's iSAM2 with its default settings: relinearising above 0.1, every tenth step.

Among false measurements it relinearises at every step, with dynamic covariance scaling on all but odometry, and QR,
since its default Cholesky factorisation throws on clean public graphs.
"""

import time

import gtsam
import numpy as np

from benchmarks.contenders import Believed
from benchmarks.contenders import gtsam_words as words
from benchmarks.drive import predicted
from benchmarks.problem import Array, Edges, Problem, Step

_DCS = gtsam.noiseModel.mEstimator.DCS.Create(1.0)


class Online:
    """iSAM2; an update is followed by reading, as anybody who needs the estimate must."""

    def __init__(self, problem: Problem, *, robust: bool = False) -> None:
        params = gtsam.ISAM2Params()
        params.setRelinearizeThreshold(0.1)
        params.relinearizeSkip = 1 if robust else 10
        if robust:
            params.setFactorization("QR")
        self.isam, self.loss, self.planar = gtsam.ISAM2(params), _DCS if robust else None, problem.planar
        self.extract = gtsam.utilities.extractPose2 if problem.planar else gtsam.utilities.extractPose3
        self.known, self.seen = 0, 0

    def prepared(self, problem: Problem) -> Problem:
        """See ``ours.Online``."""
        return words.prepared(problem)

    def take(self, step: Step, pose: Array, landmarks: Array, closures: Edges | None = None) -> None:
        """See ``ours.Online``; closures are under the loss, as sightings are."""
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        values.insert(step.pose, words.pose(pose))
        if step.pose == 0:
            words.add_anchor(graph, pose)
        words.add_relative(graph, step.relative)
        if closures is not None:
            words.add_relative(graph, closures, self.loss)
        for index, point in zip(step.landmarks, landmarks, strict=True):
            values.insert(words.landmark(index), point)
        words.add_sightings(graph, step.sightings, self.loss)
        self.isam.update(graph, values)
        self.known, self.seen = step.pose + 1, step.landmarks.stop

    def path(self) -> Array:
        """See ``ours.Online``."""
        return self.extract(self.isam.calculateEstimate())

    def pose(self, index: int) -> Array:
        """See ``ours.Online``."""
        read = self.isam.calculateEstimatePose2 if self.planar else self.isam.calculateEstimatePose3
        return words.numbers(read(index))

    def estimate(self) -> tuple[Array, Array]:
        """See ``ours.Online``."""
        return words.estimate(self.isam.calculateEstimate(), self.known, self.seen, self.planar)


def believe(problem: Problem, closures: Edges, name: str) -> Believed:
    """See ``contenders.believe``."""
    given, candidates = words.prepared(problem), words.prepared_edges(closures)
    arrived = np.searchsorted(closures.ends.max(axis=1), np.arange(len(problem.poses) + 1))
    contender, begin = Online(problem, robust=True), time.process_time()
    for step, exact in zip(given.steps(), problem.steps(), strict=True):
        try:
            now = candidates[slice(*arrived[step.pose : step.pose + 2])]
            contender.take(step, *predicted(contender, exact, problem), now)
        except RuntimeError as error:
            return Believed(online_s=time.process_time() - begin, fault=f"{words.thrown(error)} at pose {step.pose}")
    online_s = time.process_time() - begin
    return Believed(online=contender.estimate()[0], online_s=online_s)
