"""Patience with solves of everything: where measurements contradict each other, none converges, however long."""

from dataclasses import replace

from graph_slam_ros.solver import Report, Settings, Solver

_MOST_IN_A_ROW = 5
_FEW = 5  # iterations of each stage: what converges at all mostly does so


class Patience:
    """Solves of everything on the way, with few iterations after several in a row that did not converge."""

    def __init__(self, solver: Solver) -> None:
        self._solver, self._in_a_row = solver, 0

    def optimize(self, settings: Settings | None = None) -> Report:
        """Solve as ``Solver.optimize`` does."""
        settings = settings or self._solver.settings
        if self._in_a_row >= _MOST_IN_A_ROW:
            settings = replace(settings, max_iterations=min(_FEW, settings.max_iterations))
        report = self._solver.optimize(settings)
        self._in_a_row = 0 if report.converged else self._in_a_row + 1
        return report
