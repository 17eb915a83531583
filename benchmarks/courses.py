"""What contenders are driven through among false measurements: a graph, and how far a path in it is off."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from benchmarks import contenders, fresh, judge, trials
from benchmarks.contenders import OURS
from benchmarks.drive import drive
from benchmarks.problem import Array, Problem
from benchmarks.trials import Trial


@dataclass(frozen=True, slots=True)
class Course:
    """What is driven through.

    Attributes
    ----------
    trial : with false measurements, of a policy, a rate and a seed
    error_m : position error of all poses, after the rigid motion that fits best
    odometry_m : that of odometry alone
    chi2 : of poses, what odometry and true closures cost, over what they cost at the optimum; None where landmarks are
        all there is to see
    clean_policy : one of which the trial at rate 0 has no false measurement
    """

    name: str
    trial: Callable[[str, float, int], Trial]
    error_m: Callable[[Array], float]
    odometry_m: float
    chi2: Callable[[Array], float] | None
    clean_policy: str


def of_graph(problem: Problem) -> Course:
    """A graph, whose optimum is what there is to find.

    Raises
    ------
    GraphSlamError
        Some pose has no odometry to it.
    """
    odometry, closures = trials.split(problem)
    optimum = _optimum(replace(problem, poses=odometry.poses), problem)
    alone = replace(problem, sightings=problem.sightings[:0], landmarks=problem.landmarks[:0])
    least = judge.chi2(alone, optimum, alone.landmarks, "relative")
    return Course(
        problem.name,
        partial(trials.trial, problem, optimum),
        partial(judge.position_error, truth=optimum),
        judge.position_error(odometry.poses, optimum),
        (lambda poses: judge.chi2(alone, poses, alone.landmarks, "relative") / least) if len(closures) else None,
        "random" if len(closures) else "wrong_ids",
    )


def _optimum(driven: Problem, problem: Problem) -> Array:
    """The better of two: from where a drive through the graph ends, and from its own values."""
    online = fresh.call(drive, OURS, driven, False, np.inf)
    found = []
    for start in (replace(problem, poses=online.poses, landmarks=online.landmarks), problem):
        solved = fresh.call(contenders.solve, OURS, start)
        found.append((judge.chi2(problem, solved.poses, solved.landmarks, "relative"), solved.poses))
    return np.asarray(min(found, key=lambda one: one[0])[1])
