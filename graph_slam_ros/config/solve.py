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
    relinearize_above: float = setting(
        _SOLVER.relinearize_above,
        "a pose or landmark is linearised again when it has moved by more than this since (poses whose motions are "
        "longer than a metre: in units of these)",
        "m, rad",
        low=0.0,
        live=True,
    )
    relinearize_error: float = setting(
        _SOLVER.relinearize_error,
        "a pose or landmark is linearised again when its squared motion exceeds this part of the "
        "standard deviation of its strongest measurement",
        "sigma",
        low=0.0,
        live=True,
    )
    relinearize_every: int = setting(
        _SOLVER.relinearize_every,
        "relinearisation is checked at every so many updates (at each update for ten times the threshold)",
        "updates",
        low=1,
        high=1_000_000,
        live=True,
    )
    tolerance: float = setting(
        _SOLVER.tolerance,
        "changes of a pose or landmark up to this are not propagated through the graph",
        "m, rad",
        low=0.0,
        live=True,
    )
    tolerance_sigmas: float = setting(
        _SOLVER.tolerance_sigmas,
        "changes up to so many standard deviations of a pose or landmark given its neighbours are not propagated",
        "sigma",
        low=0.0,
        live=True,
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
    step_tolerance: float = setting(
        1e-5, "the solve at the end has converged when no step is larger than this", "m, rad", low=0.0, live=True
    )
    cost_tolerance: float = setting(
        1e-9,
        "the solve at the end has converged when the cost changes by a smaller fraction than this",
        "",
        low=0.0,
        live=True,
    )
