"""Robust losses by name, in the stages in which the solver uses them."""

from graph_slam_ros.graph import Loss

LEAST_LOSS_SCALE = 0.1
LOSSES = ("none", "huber", "cauchy", "geman_mcclure", "dcs", "huber_then_cauchy", "huber_then_dcs")
_WIDE = 2.3  # times as wide in the end: 4.6 standard deviations, the gate of three numbers


def landmark_stages(name: str, scale: float) -> list[Loss]:
    """The loss of landmarks: for ``huber_then_cauchy``, Huber's loss until convergence, then Cauchy's."""
    return [Loss.named(one, scale) for one in name.split("_then_")]


def narrow_then_wide(name: str, scale: float) -> list[Loss]:
    """The loss of closures and fixes: narrow first, so that outliers do not bend the map; then wide.

    A measurement that the gate accepts then has its full weight: without outliers the optimum is that of least squares.
    """
    first, *_, last = 2 * name.split("_then_")
    return [Loss.named(first, scale), Loss.named(last, _WIDE * scale)]
