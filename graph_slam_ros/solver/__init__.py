"""The solution of the problem: linearisation, ordering, the clique tree, online updates and batch optimisation."""

from graph_slam_ros.solver.batch import METHODS, Change, Iteration, Report, Settings
from graph_slam_ros.solver.initialization import initial_values
from graph_slam_ros.solver.linearization import ClassCost, LossKey
from graph_slam_ros.solver.solver import Solver

__all__ = ["METHODS", "Change", "ClassCost", "Iteration", "LossKey", "Report", "Settings", "Solver", "initial_values"]
