"""The solution of the problem: linearisation, ordering, the clique tree, online updates and batch optimisation."""

from graph_slam_ros.solver.settings import METHODS, LossKey, Settings

TYPE_CHECKING = False
if TYPE_CHECKING:
    from graph_slam_ros.solver.batch import Report
    from graph_slam_ros.solver.initialization import initial_values
    from graph_slam_ros.solver.solver import Solver

__all__ = ["METHODS", "LossKey", "Report", "Settings", "Solver", "initial_values"]

if not TYPE_CHECKING:

    def __getattr__(name: str) -> object:
        """Import a public name when it is first used (PEP 562): parameters need the settings alone."""
        from importlib import import_module

        if home := {"Report": "batch", "Solver": "solver", "initial_values": "initialization"}.get(name):
            return getattr(import_module(f"{__name__}.{home}"), name)
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
