"""Results of an update and of a batch optimisation, and why it stopped."""

from dataclasses import dataclass
from typing import NamedTuple


@dataclass(frozen=True, slots=True)
class Iteration:
    """One step: chi2 and cost after it, its largest component [m or rad], and the damping used (0: Gauss-Newton)."""

    chi2: float
    cost: float
    step: float
    damping: float


@dataclass(frozen=True, slots=True)
class ClassCost:
    """The number of edges of a label, their share of chi2, and the number of residuals in it."""

    edges: int
    chi2: float
    residuals: int


class Change(NamedTuple):
    """Result of ``Solver.update``: what one increment cost, counted once more in each pass that linearises anew.

    Attributes
    ----------
    eliminated : vertices that were eliminated again, the new ones included
    linearized : edges that were linearised, the new ones included
    moved : vertices whose step was computed again; others may follow when they are read
    """

    eliminated: int = 0
    linearized: int = 0
    moved: int = 0


@dataclass(frozen=True, slots=True)
class Report:
    """Result of ``Solver.optimize``.

    ``chi2`` is the sum of r' Omega r without any loss; ``cost`` is what was minimised, losses applied.

    Attributes
    ----------
    stop : ``step`` (largest step below its tolerance), ``cost`` (relative decrease below its tolerance),
        ``max_iterations``, ``no_decrease`` (damping found no lower cost), ``diverged``, or ``nothing_to_do``
    method : the method that gave the result; ``lm`` also where Gauss-Newton failed and was replaced
    classes : by label
    """

    method: str
    stop: str
    chi2_initial: float
    chi2_final: float
    cost_initial: float
    cost_final: float
    iterations: tuple[Iteration, ...]
    classes: dict[str, ClassCost]

    @property
    def converged(self) -> bool:
        """Return whether one of the two convergence rules ended it."""
        return self.stop in ("step", "cost", "nothing_to_do")
