"""GTSAM's iSAM2 with its default settings: relinearising above 0.1, every tenth step or (``isam2-1``) every step."""

import gtsam

from benchmarks.contenders import gtsam_words as words
from benchmarks.problem import Array, Problem, Step


class Online:
    """iSAM2; an update is followed by reading, as anybody who needs the estimate must."""

    def __init__(self, problem: Problem, name: str) -> None:
        params = gtsam.ISAM2Params()
        params.setRelinearizeThreshold(0.1)
        params.relinearizeSkip = int(name.split("-")[1])
        self.isam = gtsam.ISAM2(params)
        self.planar = problem.planar
        self.extract = gtsam.utilities.extractPose2 if problem.planar else gtsam.utilities.extractPose3
        self.known, self.seen = 0, 0

    def prepared(self, problem: Problem) -> Problem:
        """See ``contenders.Online``."""
        return words.prepared(problem)

    def take(self, step: Step, pose: Array, landmarks: Array) -> None:
        """See ``contenders.Online``."""
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        values.insert(step.pose, words.pose(pose))
        if step.pose == 0:
            words.add_anchor(graph, pose)
        words.add_relative(graph, step.relative)
        for index, point in zip(step.landmarks, landmarks, strict=True):
            values.insert(words.landmark(index), point)
        words.add_sightings(graph, step.sightings)
        self.isam.update(graph, values)
        self.known, self.seen = step.pose + 1, step.landmarks.stop

    def path(self) -> Array:
        """See ``contenders.Online``."""
        return self.extract(self.isam.calculateEstimate())

    def pose(self, index: int) -> Array:
        """See ``contenders.Online``."""
        read = self.isam.calculateEstimatePose2 if self.planar else self.isam.calculateEstimatePose3
        return words.numbers(read(index))

    def estimate(self) -> tuple[Array, Array]:
        """See ``contenders.Online``."""
        return words.estimate(self.isam.calculateEstimate(), self.known, self.seen, self.planar)
