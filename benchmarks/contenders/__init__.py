"""The contenders, by name, and what is asked of them: driving pose by pose, or solving a graph as a whole."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from importlib import import_module
from typing import Any

import numpy as np

from benchmarks.fresh import ROOT
from benchmarks.problem import Array, Edges, Problem

OURS, OURS_AS_G2O, OURS_PLAIN, ISAM2 = "ours", "ours-quaternion", "ours-plain", "iSAM2"
TOLERANCE = 1e-6  # converged when the cost changes by a smaller fraction, or no step is larger
MAX_ITERATIONS = 100

_ONLINE = {OURS: "ours", ISAM2: "isam2"}
_BATCH = {
    OURS: "ours",
    OURS_AS_G2O: "ours",
    "gtsam-gn": "gtsam_batch",
    "gtsam-lm": "gtsam_batch",
    "g2o-gn": "g2o_batch",
}
_ROBUST = {
    OURS: "ours_robust",
    OURS_PLAIN: "ours_robust",
    "gtsam-huber": "gtsam_batch",
    "gtsam-gm": "gtsam_batch",
    "gtsam-gnc": "gtsam_batch",
    "isam2-dcs": "isam2",
}
BATCH_PEERS, ROBUST_PEERS = tuple(_BATCH)[2:], tuple(_ROBUST)[2:]


@dataclass(slots=True)
class Solved:
    """How a contender went, pose by pose or with the graph as a whole.

    Attributes
    ----------
    step_s : CPU time of each step; of a whole graph there is one: from arrays to convergence, making the library's own
        graph, ordering and symbolic analysis included
    poses, landmarks : the estimate after the last step
    fault : why there is no estimate, or it is none to be proud of; empty where all is well
    """

    step_s: Array | Sequence[float] = ()
    poses: Array = field(default_factory=lambda: np.empty(0))
    landmarks: Array = field(default_factory=lambda: np.empty(0))
    fault: str = ""

    @property
    def cpu_s(self) -> float:
        """CPU time of all steps."""
        return float(sum(self.step_s))


@dataclass(slots=True)
class Believed:
    """What a contender makes of measurements of which some are false.

    Attributes
    ----------
    online, batch : poses after the last one came, and after everything was solved; empty where it does not
    online_weights, weights : what each closure, then each sighting, counts, 0 to 1; empty where it does not say
    online_s, batch_s : CPU time
    fault : why there is no path
    """

    online: Array = field(default_factory=lambda: np.empty(0))
    batch: Array = field(default_factory=lambda: np.empty(0))
    online_weights: Array = field(default_factory=lambda: np.empty(0))
    weights: Array = field(default_factory=lambda: np.empty(0))
    online_s: float = 0.0
    batch_s: float = 0.0
    fault: str = ""


def online(name: str, problem: Problem) -> Any:
    """A contender for driving, with the methods of ``ours.Online``."""
    return import_module(f"benchmarks.contenders.{_ONLINE[name]}").Online(problem)


def solve(name: str, problem: Problem) -> Solved:
    """Solve a graph as a whole; the first pose is held."""
    module = import_module(f"benchmarks.contenders.{_BATCH[name]}")
    module.solve(problem.prefix(100), name)  # so that its code is loaded and compiled
    solved: Solved = module.solve(problem, name)
    return solved


def believe(name: str, problem: Problem, closures: Edges) -> Believed:
    """Find the path from odometry, and from closures and sightings of which nobody knows whether they are true.

    Parameters
    ----------
    problem : without closures; its poses are the odometry, composed
    closures : in order of their later pose
    """
    believed: Believed = import_module(f"benchmarks.contenders.{_ROBUST[name]}").believe(problem, closures, name)
    return believed


def settled(before: float, after: float) -> bool:
    """The rule by which every iteration ends."""
    return abs(before - after) <= TOLERANCE * after


def python_of(name: str) -> str:
    """The interpreter that has a contender: g2o's wheel needs an older NumPy than everybody else's."""
    return str(ROOT / ".venv-bench-g2o/bin/python") if name.startswith("g2o") else sys.executable
