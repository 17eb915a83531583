"""The solution of the problem: linearisation, ordering, the clique tree, online updates and batch optimisation."""

from graph_slam_ros.solver.batch import METHODS, Settings
from graph_slam_ros.solver.initialization import initial_values
from graph_slam_ros.solver.linearization import LossKey
from graph_slam_ros.solver.report import Change, ClassCost, Iteration, Report
from graph_slam_ros.solver.solver import Solver

__all__ = ["METHODS", "Change", "ClassCost", "Iteration", "LossKey", "Report", "Settings", "Solver", "initial_values"]
