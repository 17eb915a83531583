"""Parameters of the solver."""

from dataclasses import dataclass

from graph_slam_ros.config.parameter import setting
from graph_slam_ros.solver import METHODS, Settings

_SOLVER = Settings()  # its defaults are ours, but for when the solve at the end has converged


@dataclass(frozen=True, slots=True)
class SolveConfig:
    """The solver: limited work at each keyframe, and everything at the end."""

    every_keyframes: int = setting(
        1, "the estimate is updated after this many keyframes", "keyframes", low=1, high=1_000_000, live=True
    )
    method: str = setting(
        _SOLVER.method,
        "method of the solve at the end: gn (Gauss-Newton, damped only where it fails to converge), "
        "lm (Levenberg-Marquardt) or dogleg",
        choices=METHODS,
        live=True,
    )
    max_iterations: int = setting(
        _SOLVER.max_iterations,
        "most iterations of the solve at the end, for each stage of the losses",
        "",
        low=1,
        high=10_000,
        live=True,
    )
