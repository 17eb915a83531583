"""Newton's method from a nearby estimate to a critical point of SE-Sync's problem."""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import diags_array

from graph_slam_ros.tools.certificate.spectrum import factorize
from graph_slam_ros.tools.certificate.synchronization import Poses, Synchronization

_MOST_STEPS = 100
_DAMPING_FIRST, _DAMPING_MOST, _FACTOR = 1e-4, 1e8, 10.0
_ROUNDING = 1e-13  # of a cost
_SMALLEST_STEP = 1e-10  # m, rad


@dataclass(frozen=True, slots=True)
class Polished:
    """A critical point, its cost, and how many steps led there; ``converged``: whether it is one."""

    poses: Poses
    cost: float
    steps: int
    converged: bool


def polish(problem: Synchronization, x: Poses, root: int) -> Polished:
    """Minimise the chordal cost from x, with the root's pose as it is.

    Newton's method converges quadratically, as Gauss-Newton does not where residuals are large, so that the gradient
    comes down to rounding: the certificate is exact at a critical point only. Where the Hessian is not positive
    definite or the cost would rise, the scaled diagonal is added (Levenberg-Marquardt); so it ends in a minimum, which
    may be a local one.
    """
    cost, damping, steps = problem.cost(x), 0.0, 0
    while steps < _MOST_STEPS:
        model = problem.newton(x, root)
        while True:
            solve = factorize((model.hessian + damping * diags_array(model.scale)).tocsc())
            if solve is not None:
                step = -solve(model.gradient)
                there = problem.retract(x, step, root)
                reached = problem.cost(there)
                if reached <= cost * (1.0 + _ROUNDING):
                    break
                if np.abs(step).max() < _SMALLEST_STEP:  # noise alone keeps a cost of next to nothing from falling
                    return Polished(x, cost, steps, True)
            damping = max(_DAMPING_FIRST, _FACTOR * damping)
            if damping > _DAMPING_MOST:
                return Polished(x, cost, steps, False)
        x, cost, steps = there, reached, steps + 1
        model_decrease = -float(model.gradient @ step)
        if damping <= 1.0 and np.abs(step).max() < _SMALLEST_STEP:  # also at a saddle, which is critical, too
            return Polished(x, cost, steps, True)
        if not damping and model_decrease <= 0.1 * _ROUNDING * cost:
            return Polished(x, cost, steps, True)
        damping = damping / _FACTOR if damping > _DAMPING_FIRST else 0.0
    return Polished(x, cost, steps, False)
