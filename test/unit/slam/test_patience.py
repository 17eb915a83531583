"""Solves of everything have few iterations after several that did not converge, and all again after one that did."""

from dataclasses import replace

from graph_slam_ros.graph import Graph
from graph_slam_ros.slam.robust.patience import _FEW, _MOST_IN_A_ROW, Patience
from graph_slam_ros.solver import Report, Settings, Solver


class Unconverged(Solver):
    """A solver whose solves end as they are told."""

    def __init__(self):
        super().__init__(Graph())
        self.converges, self.asked = False, []

    def optimize(self, settings: Settings | None = None) -> Report:
        self.asked.append(settings.max_iterations)
        return replace(super().optimize(settings), stop="step" if self.converges else "max_iterations")


def test_what_does_not_converge_costs_less_and_less_is_asked_only_until_it_does():
    solver = Unconverged()
    patience, usual = Patience(solver), solver.settings.max_iterations
    for _ in range(_MOST_IN_A_ROW + 2):
        patience.optimize()
    assert solver.asked == [usual] * _MOST_IN_A_ROW + [_FEW] * 2
    solver.converges = True
    patience.optimize()
    patience.optimize()
    assert solver.asked[-2:] == [_FEW, usual]
    patience.optimize(replace(solver.settings, max_iterations=2))
    assert solver.asked[-1] == 2
