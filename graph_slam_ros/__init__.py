"""Online pose-graph SLAM for robots with odometry and observations of landmarks.

No name here needs ROS. Each is imported when it is first used, so ``import graph_slam_ros`` is fast. Vertex types, edge
types and losses are in ``graph_slam_ros.graph``.
"""

__version__ = "0.1.0"

TYPE_CHECKING = False  # type checkers take it for true; typing itself is slow to import
if TYPE_CHECKING:
    from graph_slam_ros.config import Config
    from graph_slam_ros.formats.g2o import read_g2o
    from graph_slam_ros.formats.g2o_writer import write_g2o
    from graph_slam_ros.graph import Gaussian, Graph
    from graph_slam_ros.maps.edit import edit_run
    from graph_slam_ros.measurements import Control, Odometry, Sighting, Sightings
    from graph_slam_ros.optimization import Solution, optimize
    from graph_slam_ros.runs.replay import replay
    from graph_slam_ros.runs.saved_run import SavedRun, load_run
    from graph_slam_ros.slam import GraphSlam
    from graph_slam_ros.solver import Settings, Solver
    from graph_slam_ros.tools.certificate.certify import Certificate, certify

__all__ = [
    "Certificate",
    "Config",
    "Control",
    "Gaussian",
    "Graph",
    "GraphSlam",
    "Odometry",
    "SavedRun",
    "Settings",
    "Sighting",
    "Sightings",
    "Solution",
    "Solver",
    "certify",
    "edit_run",
    "load_run",
    "optimize",
    "read_g2o",
    "replay",
    "write_g2o",
]

_HOMES = {
    "optimization": ("Solution", "optimize"),
    "tools.certificate": ("Certificate", "certify"),
    "config": ("Config",),
    "formats.g2o": ("read_g2o",),
    "formats.g2o_writer": ("write_g2o",),
    "graph": ("Gaussian", "Graph"),
    "maps.edit": ("edit_run",),
    "measurements": ("Control", "Odometry", "Sighting", "Sightings"),
    "runs.replay": ("replay",),
    "runs.saved_run": ("SavedRun", "load_run"),
    "slam": ("GraphSlam",),
    "solver": ("Settings", "Solver"),
}

if not TYPE_CHECKING:  # or type checkers would believe in every name

    def __getattr__(name: str) -> object:
        """Import a public name when it is first used (PEP 562)."""
        for home, names in _HOMES.items():
            if name in names:
                from importlib import import_module

                value = globals()[name] = getattr(import_module(f"{__name__}.{home}"), name)
                return value
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
