"""The contenders, by name, and what is asked of them: driving pose by pose, or solving a graph as a whole."""

import sys
from dataclasses import dataclass, field
from importlib import import_module
from typing import Protocol

import numpy as np

from benchmarks.fresh import ROOT
from benchmarks.problem import Array, Problem, Step

OURS, OURS_AS_G2O = "ours", "ours-quaternion"
TOLERANCE = 1e-6  # converged when the cost changes by a smaller fraction, or no step is larger
MAX_ITERATIONS = 100

_ONLINE = {OURS: "ours", "isam2-10": "isam2", "isam2-1": "isam2"}
_BATCH = {
    OURS: "ours",
    OURS_AS_G2O: "ours",
    "gtsam-gn": "gtsam_batch",
    "gtsam-lm": "gtsam_batch",
    "g2o-gn": "g2o_batch",
    "g2o-lm": "g2o_batch",
    "graphslam": "graphslam_batch",
}
ONLINE_PEERS, BATCH_PEERS = tuple(_ONLINE)[1:], tuple(_BATCH)[2:]


class Online(Protocol):
    """Someone who is given one pose at a time."""

    def prepared(self, problem: Problem) -> Problem:
        """The problem with measurements and noise in the form the library takes; not timed."""

    def take(self, step: Step, pose: Array, landmarks: Array) -> None:
        """Take a step's pose and new landmarks at their predicted values, and its edges; be up to date after it."""

    def path(self) -> Array:
        """All poses so far as an array, in whatever numbers the library has for a pose."""

    def pose(self, index: int) -> Array:
        """One pose, (3,) or (7,)."""

    def estimate(self) -> tuple[Array, Array]:
        """All poses, (n, 3) or (n, 7), and all landmarks, (n, 2)."""


@dataclass(slots=True)
class Solved:
    """How a batch solver went.

    Attributes
    ----------
    build_s : CPU time for making the library's own graph from arrays
    solve_s : CPU time from there to convergence, ordering and symbolic analysis included
    fault : why there is no estimate, or it is none to be proud of; empty where all is well
    """

    build_s: float = 0.0
    solve_s: float = 0.0
    iterations: int = 0
    poses: Array = field(default_factory=lambda: np.empty(0))
    landmarks: Array = field(default_factory=lambda: np.empty(0))
    fault: str = ""


def settled(before: float, after: float) -> bool:
    """The rule by which every iteration ends."""
    return abs(before - after) <= TOLERANCE * after


def online(name: str, problem: Problem) -> Online:
    """A contender for driving."""
    contender: Online = import_module(f"benchmarks.contenders.{_ONLINE[name]}").Online(problem, name)
    return contender


def solve(name: str, problem: Problem) -> Solved:
    """Solve a graph as a whole; the first pose is held."""
    module = import_module(f"benchmarks.contenders.{_BATCH[name]}")
    module.solve(problem.prefix(100), name)  # so that its code is loaded and compiled
    solved: Solved = module.solve(problem, name)
    return solved


def error_map(name: str, planar: bool) -> str:
    """What a contender minimises, see ``judge``."""
    if name.startswith(("isam2", "gtsam")):
        return "logarithm"
    if name == "graphslam":
        return "inverse"
    return "quaternion" if not planar and name in ("g2o-gn", "g2o-lm", OURS_AS_G2O) else "relative"


def python_of(name: str) -> str:
    """The interpreter that has a contender: g2o's wheel needs an older NumPy than everybody else's."""
    return str(ROOT / ".venv-bench-g2o/bin/python") if name.startswith("g2o") else sys.executable
