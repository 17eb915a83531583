"""How the problem is solved: linearisation, normal equations, Gauss-Newton and Levenberg-Marquardt, marginals."""

from graph_slam_ros.solver.descent import Settings
from graph_slam_ros.solver.initialization import initial_values
from graph_slam_ros.solver.report import ClassCost, Iteration, Report
from graph_slam_ros.solver.solver import Solver

__all__ = ["ClassCost", "Iteration", "Report", "Settings", "Solver", "initial_values"]
